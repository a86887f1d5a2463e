"""What is installed, found by entry points: distributions of others, as their metadata and modules say."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import pytest

from acquire import plugins
from acquire.config import RigConfig, load_scene
from acquire.config.scene import SceneFile
from acquire.config.schema import whole_schema
from acquire.errors import ConfigError
from acquire.plugins import CAMERAS, EFFECTS

GLOW = """
from typing import ClassVar, Literal
from acquire.sim.effects.base import Effect, Stage

class Glow(Effect):
    '''Steady light of the room.'''
    kind: Literal["glow"]
    place: ClassVar = "signal"
    level: float = 1.0

    def stages(self, setting):
        return [Stage("glow", "signal", lambda lines, first_line: lines + self.level)]
"""

Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Puts a distribution where Python finds it: name, entry points of effects, source of its module."""
    monkeypatch.syspath_prepend(str(tmp_path))
    modules = set(sys.modules)

    def add(name: str, effects: dict[str, str], source: str = "") -> None:
        about = tmp_path / f"{name.replace('-', '_')}-1.5.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.5\n")
        entries = "".join(f"{key} = {value}\n" for key, value in effects.items())
        (about / "entry_points.txt").write_text(f"[acquire.effects]\n{entries}")
        (tmp_path / f"{name.replace('-', '_')}.py").write_text(source)
        plugins.forget()

    plugins.forget()
    yield add
    for name in set(sys.modules) - modules:
        if name in ("lab_light", "lab_other"):
            del sys.modules[name]
    monkeypatch.undo()
    plugins.forget()


def scene(tmp_path: Path, *effects: str) -> Path:
    """A scene file that lists effects, each as TOML."""
    path = tmp_path / "scene.toml"
    path.write_text('kind = "usaf"\n' + "".join(f"[[effects]]\n{effect}\n" for effect in effects))
    return path


def test_an_effect_of_anybodys_is_found_without_being_imported_and_imported_when_listed(
    install: Install, tmp_path: Path
) -> None:
    install("lab-light", {"glow": "lab_light:Glow"}, GLOW)
    assert EFFECTS.names()[-1] == "glow"
    assert "lab_light" not in sys.modules
    listed = load_scene(scene(tmp_path, 'kind = "glow"\nlevel = 2.5')).effects[0]
    assert (type(listed).__module__, listed.model_dump()) == ("lab_light", {"kind": "glow", "level": 2.5})
    again = SceneFile.model_validate(load_scene(scene(tmp_path, 'kind = "glow"')).model_dump()).root
    assert type(again.effects[0]) is EFFECTS.load("glow")


def test_mistakes_in_its_table_are_named_as_those_in_ours(install: Install, tmp_path: Path) -> None:
    install("lab-light", {"glow": "lab_light:Glow"}, GLOW)
    with pytest.raises(ConfigError) as caught:
        load_scene(scene(tmp_path, 'kind = "glow"\nlevel = "high"', 'kind = "glow"\nlevl = 3'))
    assert "effects.0.level = 'high': " in str(caught.value)
    told = "effects.1.levl: unknown key; did you mean 'level'?; allowed here: kind, level"
    assert told in str(caught.value)


def test_an_unknown_effect_is_refused_with_those_there_are_and_their_origin(
    install: Install, tmp_path: Path
) -> None:
    install("lab-light", {"glow": "lab_light:Glow"}, GLOW)
    with pytest.raises(ConfigError, match="did you mean 'read_noise'") as caught:
        load_scene(scene(tmp_path, 'kind = "read_nose"'))
    with pytest.raises(ConfigError, match="did you mean 'glow'") as near:
        EFFECTS.load("glo")
    assert "shot_noise, " in str(caught.value)
    assert near.value.possible.endswith("glow (lab-light 1.5)")


@pytest.mark.parametrize(
    ("value", "source", "why"),
    [
        ("lab_light:Glow", "import nothing_of_this_name", "ModuleNotFoundError: No module named 'nothing"),
        ("lab_light:Glow", "def broken(:", "SyntaxError"),
        ("lab_light:Glow", "raise SystemExit('no licence')", "SystemExit: no licence"),
        ("lab_light:Gone", GLOW, "has no attribute 'Gone'"),
        ("lab light::", GLOW, "its entry point 'lab light::' is not MODULE:CLASS"),
        ("", GLOW, "its entry point '' is not MODULE:CLASS"),
        ("lab_light:Glow", "raise MemoryError", r"MemoryError; possible"),
        ("lab_light:Stage", GLOW, "is not a class that extends acquire.sim.effects.base.Effect"),
        ("lab_light:Glow", GLOW.replace('"glow"]', '"glare"]'), r"needs kind: Literal\['glow'\]"),
        ("lab_light:Glow", GLOW.replace("def stages", "def steps"), "does not define stages"),
        (
            "lab_light:Glow",
            GLOW.replace("(self, setting)", "(self)"),
            r"needs stages\(self, setting\): too many",
        ),
    ],
)
def test_a_broken_one_is_left_out_and_only_who_asks_for_it_is_refused(
    install: Install, tmp_path: Path, value: str, source: str, why: str
) -> None:
    install("lab-light", {"glow": value}, source)
    assert "glow" not in EFFECTS.working()
    assert load_scene(scene(tmp_path, 'kind = "shot_noise"')).effects[0].kind == "shot_noise"
    with pytest.raises(ConfigError, match=f"'glow' of lab-light 1.5 cannot be used: .*{why}"):
        EFFECTS.load("glow")
    with pytest.raises(ConfigError, match=r"effects\.0: effect 'glow' of lab-light 1\.5"):
        load_scene(scene(tmp_path, 'kind = "glow"'))


def test_what_its_module_prints_is_not_in_the_output(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    """It came before the JSON of every command that imports it."""
    install("lab-light", {"glow": "lab_light:Glow"}, f"print('hello')\n{GLOW}")
    assert EFFECTS.load("glow").__name__ == "Glow"
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "hello\n")


def test_our_names_stay_ours_and_a_name_of_two_is_nobodys(install: Install) -> None:
    install("lab-light", {"glow": "lab_light:Glow", "psf": "lab_light:Glow"}, GLOW)
    install("lab-other", {"glow": "lab_other:Glow"}, GLOW)
    assert EFFECTS.load("psf").__module__ == "acquire.sim.effects.image"
    with pytest.raises(ConfigError, match=r"lab-light 1.5 and lab-other 1.5 both have it.*uninstall one"):
        EFFECTS.load("glow")
    refused = {(each.name, each.distribution): each.refused for each in EFFECTS.found() if each.refused}
    assert refused["psf", "lab-light"] == "the name is tdi-acquire's own"
    assert set(refused) == {("psf", "lab-light"), ("glow", "lab-light"), ("glow", "lab-other")}
    assert len(set(EFFECTS.names())) == len(EFFECTS.names())


def test_the_schema_has_what_is_installed_told_apart_by_kind(install: Install) -> None:
    install("lab-light", {"glow": "lab_light:Glow", "dull": "lab_light:Dull"}, GLOW)
    schema = whole_schema(SceneFile)["$defs"]
    mapping = schema["acquire.effects"]["discriminator"]["mapping"]
    assert set(mapping) == {*EFFECTS.names()} - {"dull"}
    glow = schema[mapping["glow"].removeprefix("#/$defs/")]
    assert set(glow["properties"]) == {"kind", "level"}
    assert glow["properties"]["kind"]["const"] == "glow"


def test_the_schema_of_a_rig_has_every_drivers_options() -> None:
    camera = whole_schema(RigConfig)["$defs"]["CameraConfig"]
    options = {rule["if"]["properties"]["driver"]["const"]: rule["then"] for rule in camera["allOf"]}
    assert set(options) == set(camera["properties"]["driver"]["enum"]) == set(CAMERAS.names())
    ref = options["aravis"]["properties"]["options"]["$ref"]
    assert whole_schema(RigConfig)["$defs"][ref.removeprefix("#/$defs/")]["additionalProperties"] is False


def test_a_checkout_that_is_newer_than_its_installation_says_so(
    install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_yet(name: str) -> metadata.Distribution:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", none_yet)
    plugins.forget()
    with pytest.raises(ConfigError, match=r"pip install -e \. --no-deps in .*pyproject.toml is newer"):
        EFFECTS.load("shot_noise")


def test_fields_that_no_file_can_fill_are_named_with_what_to_write(install: Install, tmp_path: Path) -> None:
    """pydantic said "Input should be a valid list" of a list, and "an instance of Path" of a path."""
    fields = "levels: list[float] = []\n    names: set[str] = set()\n    file: Path = Path()\n"
    source = GLOW.replace(
        "level: float = 1.0\n", f"level: float = 1.0\n    {fields}    two: tuple[int, ...] = ()\n"
    )
    install("lab-light", {"glow": "lab_light:Glow"}, f"from pathlib import Path\n{source}")
    table = 'kind = "glow"\nlevels = [1.0]\nnames = ["a"]\nfile = "x.png"\ntwo = 2'
    with pytest.raises(ConfigError) as refused:
        load_scene(scene(tmp_path, table))
    found = [line.strip().removeprefix("effects.0.") for line in str(refused.value).splitlines()[1:]]
    asks, be = "the plug-in asks for a", "which no file can hold; its field should be"
    assert found == [
        f"levels = [1.0]: {asks} list, {be} a tuple",
        f"names = ['a']: {asks} set, {be} a tuple",
        f"file = 'x.png': {asks} Path, {be} acquire.config.base.FilePath",
        "two = 2: a list is expected",
    ]
