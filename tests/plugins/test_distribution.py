"""A distribution of somebody else's adds a variant of every kind; another one is broken."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from packed import install

from acquire.config import load_recorded
from acquire.errors import ConfigError, UsageError
from acquire.store import open_recording

HERE = Path(__file__).parent
RIG = """
name = "lab"
[geometry]
stages = 8
substeps = 2
[trigger]
substep_ticks = 4500
tag_every_lines = 64
[cameras.a]
serial = "A"
responsivity_dn = 50.0
{driver}
[cameras.b]
serial = "B"
responsivity_dn = 50.0
{driver}
[simulation]
scene = "stars.toml"
"""
SCENE = """
kind = "stars"
count = 5
{more}
[[effects]]
kind = "flicker"
depth = 0.4
[[effects]]
kind = "read_noise"
sigma_e = 5.0
"""

DOCUMENT = Path(__file__).parents[2] / "acquire" / "PLUGINS.md"

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where both distributions are installed."""
    place = tmp_path_factory.mktemp("site")
    for name in ("lab_extras", "lab_broken"):
        install(HERE / name, place, place.parent / "wheels")
    return place


@pytest.fixture
def acquire(target: Path, tmp_path: Path) -> Run:
    """A command of the installed program, in an environment that has both."""
    (tmp_path / "rig.toml").write_text(RIG.format(driver=""))
    (tmp_path / "stars.toml").write_text(SCENE.format(more=""))

    searched = os.pathsep.join(filter(None, [str(target), os.environ.get("PYTHONPATH")]))

    def run(*words: str, program: tuple[str, ...] = ("-m", "acquire")) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *program, *words],
            check=False,
            capture_output=True,
            text=True,
            timeout=300,
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": searched},
        )

    return run


def test_what_is_there_is_listed_with_whose_it_is_and_what_is_broken_with_its_error(acquire: Run) -> None:
    done = acquire("plugins", "--json")
    rows: list[dict[str, Any]] = json.loads(done.stdout)
    theirs = {(row["kind"], row["name"]): row for row in rows if row["distribution"] == "lab-extras"}
    assert set(theirs) == {
        ("effect", "flicker"),
        ("scene", "stars"),
        ("camera driver", "ramp"),
        ("trigger driver", "slow-link"),
        ("codec", "differences"),
        ("solver", "least-squares"),
        ("denoiser", "local-wiener"),
    }
    assert all(row["works"] and row["version"] == "0.3" and row["about"] for row in theirs.values())
    broken = {row["name"]: row["error"] for row in rows if not row["works"]}
    assert set(broken) == {
        "haze",
        "haze-free",
        "haze-lines",
        "unnamed",
        "nowhere",
        "no-prox",
        "needs-argument",
    }
    for name in ("haze", "haze-free", "haze-lines"):
        assert "No module named 'library_that_nobody_installed'" in broken[name]
    assert broken["nowhere"].startswith("lab_careless:Nowhere needs place: one of light, image,")
    assert broken["unnamed"] == "lab_careless:Unnamed needs zarr_name, its name in the metadata of arrays"
    assert broken["no-prox"] == "lab_careless:NoProx is not a class with a method prox(frames, weight)"
    assert "cannot be made without arguments: missing a required" in broken["needs-argument"]
    assert sum(row["distribution"] == "tdi-acquire" for row in rows) >= 45


def test_a_misspelt_group_is_named(acquire: Run) -> None:
    """Its plug-ins were absent from the list, without a word."""
    assert (
        "lab-broken: there is no group acquire.effect; possible: acquire.effects" in acquire("plugins").stdout
    )


@pytest.mark.parametrize(
    ("scene", "effect", "code", "told"),
    [
        (
            "oblong",
            "",
            2,
            "scene 'oblong' of lab-broken 0.1 gave back shape (1, 16, 15) for one frame\n"
            "  possible: (1, 16, 16)",
        ),
        (
            'gloom"\nfile = "/nowhere/sky.npy',
            "",
            2,
            "scene 'gloom' of lab-broken 0.1 cannot be built: /nowhere/sky.npy: No such file or directory",
        ),
        (
            "stars",
            "lost",
            2,
            "effect 'lost' of lab-broken 0.1 cannot be set up: /nowhere/gain.npy: No such file or directory",
        ),
        ("stars", "short", 2, "effect short gave back shape (255, 8) for lines of shape (256, 8)"),
        ("stars", "hollow", 1, "effect hollow gave back values that are not numbers (NaN)"),
        ("stars", "raises", 1, "This error arose in a plug-in: lab_careless of lab-broken 0.1."),
    ],
)
def test_mistakes_in_use_are_named_with_the_plug_in(
    acquire: Run, tmp_path: Path, scene: str, effect: str, code: int, told: str
) -> None:
    effects = f'[[effects]]\nkind = "{effect}"\n' if effect else ""
    (tmp_path / "scene.toml").write_text(f'kind = "{scene}"\n{effects}')
    made = acquire("simulate", "scene.toml", "--config", "rig.toml", "--lines", "300", "--out", "x.zarr")
    assert made.returncode == code
    assert told in made.stderr


@pytest.mark.parametrize("light", ["-1.5", "-1e-30", "nan", "inf", "-inf"])
@pytest.mark.parametrize("masks", ["false", "true"], ids=["frames", "masks"])
def test_light_that_cannot_be_is_refused_with_its_place(
    acquire: Run, tmp_path: Path, light: str, masks: str
) -> None:
    """Negative light was recorded as darker lines, without a word."""
    (tmp_path / "scene.toml").write_text(f'kind = "gloom"\nlight = "{light}"\nmasks = {masks}\n')
    made = acquire("simulate", "scene.toml", "--config", "rig.toml", "--lines", "600", "--out", "x.zarr")
    assert made.returncode == 2, made.stderr
    told = re.search(
        r"scene 'gloom' of lab-broken 0\.1 gave back light of (\S+) at sub-step (\d+), (.*)", made.stderr
    )
    assert told is not None, made.stderr
    assert float(told[1]) == pytest.approx(float(light), nan_ok=True)
    assert 700 <= int(told[2]) < 710  # the first that is lit
    assert told[3].endswith("pixel (3, 5)")
    assert "possible: finite numbers, 0 or more\n  try: its author" in made.stderr


def test_a_trigger_derived_from_the_simulated_one_supports_what_that_supports(
    acquire: Run, tmp_path: Path
) -> None:
    """The window and the lead of the light were refused, by the trigger's name."""
    trigger = 'driver = "slow-link"\nlight = { lead_ticks = 45, open_ticks = 90 }'
    rig = RIG.format(driver="").replace("[trigger]\n", f"[trigger]\n{trigger}\n")
    (tmp_path / "slow.toml").write_text(rig)
    checked = acquire("config", "check", "slow.toml")
    assert checked.returncode == 0, checked.stderr


def test_the_doctor_names_those_that_are_broken(acquire: Run) -> None:
    told = next(each for each in json.loads(acquire("doctor", "--json").stdout) if each["name"] == "plug-ins")
    assert (told["level"], "effect haze of lab-broken 0.1" in told["text"]) == ("warning", True)
    assert "lab-extras" not in told["text"]


def test_its_scene_with_its_effect_is_simulated_and_solved_by_its_solver(
    acquire: Run, tmp_path: Path
) -> None:
    made = acquire("simulate", "stars.toml", "--config", "rig.toml", "--lines", "160", "--out", "run.zarr")
    assert made.returncode == 0, made.stderr
    attrs = json.loads((tmp_path / "run.zarr/zarr.json").read_text())["attributes"]
    assert [effect["kind"] for effect in attrs["effects"]] == ["flicker", "read_noise"]
    assert (attrs["scene"]["kind"], attrs["scene"]["fastest_hz"]) == ("stars", 2000.0)
    used = [("scene", "stars"), ("effect", "flicker")]
    theirs = {"distribution": "lab-extras", "version": "0.3"}
    assert attrs["plugins"] == [{"kind": kind, "name": name, **theirs} for kind, name in used]
    assert (
        "scene stars of lab-extras 0.3, effect flicker of lab-extras 0.3"
        in acquire("info", "run.zarr").stdout
    )
    words = "run.zarr --out video.zarr --nm 1 --tm 4 --lines 60 --workers 1 --json --solver least-squares"
    solved = acquire("reconstruct", *words.split(), "--set", "ridge=0.002", "--iterations", "60")
    assert solved.returncode == 0, solved.stderr
    facts = json.loads(solved.stdout)
    assert (facts["solver"], facts["solver_options"]) == ("least-squares", {"ridge": 0.002})
    assert facts["quality"]["misfit"] < 0.2
    provenance = json.loads((tmp_path / "video.zarr/zarr.json").read_text())["attributes"]["provenance"]
    assert provenance["plugins"] == [{"kind": "solver", "name": "least-squares", **theirs}]
    recording = open_recording(tmp_path / "run.zarr")  # here, where nothing of theirs is installed
    assert recording.cut(0, 100).mask.all()
    with pytest.raises(ConfigError, match=r"run\.zarr, as it was recorded: .*\n.*scene 'stars' is not known"):
        load_recorded(recording.attrs, str(recording))


def test_its_codec_packs_a_recording_that_is_read_where_it_is_installed(acquire: Run, tmp_path: Path) -> None:
    codec = '[recording]\ncodec = "differences"\ncodec_options = { level = 3 }\n'
    (tmp_path / "packed.toml").write_text(RIG.format(driver="") + codec)
    words = ("stars.toml", "--lines", "200", "--config")
    for rig, name in (("rig.toml", "plain.zarr"), ("packed.toml", "run.zarr")):
        made = acquire("simulate", *words, rig, "--out", name)
        assert made.returncode == 0, made.stderr
    read = "import sys, zarr; print(zarr.open_group(sys.argv[1])['b/lines'][:].tolist())"
    plain, packed = (acquire(name, program=("-c", read)).stdout for name in ("plain.zarr", "run.zarr"))
    assert packed == plain != ""
    attrs = json.loads((tmp_path / "run.zarr/zarr.json").read_text())["attributes"]
    assert [each["name"] for each in attrs["plugins"] if each["kind"] == "codec"] == ["differences"]
    assert "not readable" not in acquire("info", "run.zarr").stdout
    assert acquire("verify", "run.zarr").returncode == 0
    # Here, where nothing of theirs is installed:
    recording = open_recording(tmp_path / "run.zarr")
    with pytest.raises(UsageError, match=r"codec 'differences' of lab-extras 0\.3.*lab-extras==0\.3"):
        recording.cut(0, 100)
    alone = subprocess.run(
        [sys.executable, "-m", "acquire", "info", tmp_path / "run.zarr"],
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )
    words = " ".join(alone.stdout.split())
    assert "not readable the pixels are packed by the codec 'differences' of lab-extras 0.3" in words
    assert "pip install 'lab-extras==0.3'" in words


@pytest.mark.parametrize(
    ("codec", "why"),
    [
        ('codec = "differences"\ncodec_options = { level = 11 }', "recording.codec_options.level = 11"),
        ('codec = "difference"', "did you mean 'differences'?"),
        ('codec = "haze-lines"', "codec 'haze-lines' of lab-broken 0.1 cannot be used: ModuleNotFoundError"),
    ],
)
def test_codecs_that_cannot_be_used_are_refused(acquire: Run, tmp_path: Path, codec: str, why: str) -> None:
    (tmp_path / "wrong.toml").write_text(f"{RIG.format(driver='')}[recording]\n{codec}\n")
    refused = acquire("config", "check", "wrong.toml")
    assert refused.returncode == 2
    assert why in refused.stderr


def test_options_of_its_camera_are_checked(acquire: Run, tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text(RIG.format(driver='driver = "ramp"\noptions = { step = 0 }'))
    refused = acquire("config", "check", "wrong.toml")
    assert refused.returncode == 2
    assert "cameras.a.options.step = 0" in refused.stderr


def test_misspelt_and_broken_effects_are_refused_by_name(acquire: Run, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text(SCENE.format(more='[[effects]]\nkind = "haze"').replace('er"', 'r"'))
    refused = acquire("simulate", "bad.toml", "--config", "rig.toml", "--lines", "9", "--out", "x.zarr")
    assert refused.returncode == 2
    assert "effect 'haze' of lab-broken 0.1 cannot be used: ModuleNotFoundError" in refused.stderr
    assert "effect 'flickr' is not known: did you mean 'flicker'?" in refused.stderr
    assert not (tmp_path / "x.zarr").exists()


def test_it_passes_the_suites_that_are_public(acquire: Run) -> None:
    suite = ("-q", "-p", "no:cacheprovider", "--numprocesses=0", str(HERE / "lab_extras/check_lab_extras.py"))
    done = acquire(*suite, program=("-m", "pytest"))
    assert done.returncode == 0, done.stdout
    assert "skipped" not in done.stdout


def test_the_document_can_be_copied_from_top_to_bottom(monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```python\n(.*?)\n```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    for name, text in (("lab_extras", "\n\n\n".join(blocks[:-1])), ("check_lab_extras", blocks[-1])):
        module = ModuleType(name)
        monkeypatch.setitem(sys.modules, name, module)
        exec(compile(text, f"{DOCUMENT.name}: {name}", "exec"), vars(module))
    assert {
        "Flicker",
        "Stars",
        "RampCameras",
        "SlowLinkTrigger",
        "Differences",
        "LeastSquares",
        "LocalWiener",
    } <= set(vars(sys.modules["lab_extras"]))


def test_the_document_shows_what_is_installed_here() -> None:
    shown = re.findall(r"```(?:python|toml)\n(.*?)\n```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    files = [path.read_text(encoding="utf-8") for path in sorted((HERE / "lab_extras").glob("*.*"))]
    assert len(shown) >= 6
    for block in shown:
        for part in block.split("\n\n\n"):
            assert any(part in text for text in files), part
