"""``acquire config``: its answers for good files and for bad ones."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquire.config import RigConfig, builtin_directory, load_plan, load_rig, load_scene
from acquire.errors import ConfigError

Cli = Callable[..., Any]


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    text = (builtin_directory() / "rig-demo.toml").read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    return path


def test_check(cli: Cli, rig_file: Path) -> None:
    answer = cli("config", "check", rig_file)
    assert answer.code == 0
    assert "valid" in answer.out
    assert "n = 192" in answer.out
    facts = cli("config", "check", rig_file, "--json").json
    assert facts["valid"]
    assert facts["line_rate_hz"] == pytest.approx(90e6 / 2700)
    assert facts["bytes_per_s"] == pytest.approx(2 * 64 * 2 * 90e6 / 2700)


@pytest.mark.parametrize(
    ("before", "after", "key"),
    [
        ("stages = 64", "stages = 0", "geometry.stages"),
        ("substeps = 3", "substeps = 3\nsubstep = 4", "geometry.substep"),
        ('codec = "lz4"', 'codec = "zip"', "recording.codec"),
        ('scene = "scene-leds.toml"', 'scene = "none.toml"', "none.toml"),
        ("[geometry]", "[geometry", "not TOML"),
        ("speed = 1.0", "speed = inf", "simulation.speed"),
        ("= 256\nring_seconds = 3.0", "= 128\nring_slots = 2", "trigger.tag_every_lines"),
        ("= 256\nring_seconds = 3.0", "= 65536\nring_slots = 4096", "stream.ring_slots x stream.block_lines"),
        ("ring_seconds = 3.0", "ring_seconds = 3e6", "stream.ring_seconds"),
        ("speed = 1.0", 'speed = 1.0\n[events]\nsources = ["mark"]\npre_s = 2.6', "events.pre_s"),
        ("speed = 1.0", 'speed = 1.0\n[events]\nsources = ["threshold"]', "level_dn above hysteresis_dn"),
    ],
)
def test_bad_files_name_the_key(cli: Cli, rig_file: Path, before: str, after: str, key: str) -> None:
    rig_file.write_text(rig_file.read_text().replace(before, after))
    for command in ("check", "show"):
        answer = cli("config", command, rig_file)
        assert answer.code == 2
        assert key in answer.err
        assert answer.out == ""


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            "substep_ticks = 9000\ncamera_min_period_ticks = 30_000",
            "27000 ticks apart; possible: 30000 or more",
        ),
        (
            "a.delay_ticks = 2650",
            "A is 90 ticks wide and 2650 late: too much; possible: delay + width below the 2700",
        ),
        ("b.width_ticks = 2700", "the pulse of camera B is 2700 ticks wide and 0 late"),
        (
            "light.open_ticks = 901",
            "the light cannot be on from tick 901 to 900 of a sub-step; possible: within 0 to 900",
        ),
        (
            "substep_ticks = 200\nlight.lead_ticks = 200",
            "the light cannot be 200 ticks ahead; possible: at most 199",
        ),
        (
            "light.scene_gate = true",
            "this device has no scene gate for the light; possible: trigger.light.scene_gate = false",
        ),
        ("b.strobe = true", "this device cannot watch the strobes of camera B"),
        ("line_start = 'per-substep'", "trigger.line_start = 'per-substep' cannot be simulated"),
        ("external_start = 'rising'", "trigger.external_start = 'rising' cannot be simulated"),
        ("b.direction = 'reverse'", "trigger.b.direction = 'reverse' cannot be simulated"),
        (
            "light.close_ticks = 450\ndriver = 'rtl'",
            "trigger.light.open_ticks, light.close_ticks cannot be simulated",
        ),
        (
            "light.lead_ticks = 31\ndriver = 'rtl'",
            "trigger.light.lead_ticks = 31 cannot be simulated; possible: 0, or driver = 'simulated'",
        ),
        ("driver = 'serial'\nurl = '/dev/ttyUSB0'", "cannot be triggered by trigger.driver = 'serial'"),
        ("driver = 'serial'", "driver 'serial' needs a url"),
        (
            "driver = 'serial'\nurl = 'x'\nbaud = 9600",
            "possible: every 2501 lines over a link of 960 bytes/s",
        ),
    ],
)
def test_settings_that_no_trigger_supports_are_refused(
    cli: Cli, rig_file: Path, line: str, words: str
) -> None:
    text = rig_file.read_text(encoding="utf-8")
    keys = [new.partition(" =")[0] for new in line.splitlines()]
    kept = "\n".join(old for old in text.splitlines() if old.partition(" =")[0] not in keys)
    rig_file.write_text(kept.replace("[trigger]", f"[trigger]\n{line}"), encoding="utf-8")
    answer = cli("config", "check", rig_file)
    assert answer.code == 2
    assert words in " ".join(answer.err.split()).replace(" possible:", "; possible:")


def test_sub_steps_that_no_trigger_has_are_found_by_check(cli: Cli, rig_file: Path) -> None:
    rig_file.write_text(rig_file.read_text().replace("substeps = 3", "substeps = 4"))
    answer = cli("config", "check", rig_file)
    assert answer.code == 2
    assert "4 sub-steps per line\n  possible: 1, 2, 3, 6\n  try: change geometry.substeps" in answer.err


def test_bad_scene_is_found_by_check(cli: Cli, rig_file: Path) -> None:
    scene = (builtin_directory() / "scene-leds.toml").read_text(encoding="utf-8")
    (rig_file.parent / "scene-leds.toml").write_text(scene.replace("size = 0.36", "size = 3.6", 1))
    answer = cli("config", "check", rig_file)
    assert answer.code == 2
    assert "leds.0.size" in answer.err


def test_show_prints_an_equivalent_file(cli: Cli, rig_file: Path, tmp_path: Path) -> None:
    shown = tmp_path / "shown.toml"
    shown.write_text(cli("config", "show", rig_file).out)
    assert load_rig(shown) == load_rig(rig_file)
    assert tomllib.loads(shown.read_text())["stream"]["ring_slots"] == 64
    assert RigConfig.model_validate(cli("config", "show", rig_file, "--json").json) == load_rig(rig_file)


def test_show_keeps_the_whole_address_of_a_webhook(cli: Cli, rig_file: Path) -> None:
    with rig_file.open("a") as file:
        file.write("\n[hooks]\nwebhook = 'https://chat.example/T0/s3cret'\n")
    assert 'hooks.webhook = "https://chat.example/T0/s3cret"' in cli("config", "show", rig_file).out


def test_schema_describes_every_key(cli: Cli) -> None:
    schema = cli("config", "schema").json
    assert set(RigConfig.model_fields) == set(schema["properties"])


def test_code_without_a_kind_is_pseudo_random(rig_file: Path) -> None:
    text = rig_file.read_text().replace('kind = "prbs"\n', "")
    assert text != rig_file.read_text()
    expected = load_rig(rig_file).code
    rig_file.write_text(text)
    assert load_rig(rig_file).code == expected


def test_the_directory_of_recordings_must_exist(cli: Cli, rig_file: Path) -> None:
    rig_file.write_text(rig_file.read_text().replace("[recording]", '[recording]\ndirectory = "/nowhere"'))
    answer = cli("config", "check", rig_file)
    assert answer.code == 2
    assert "/nowhere" in answer.err


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("recording.directory", "{file}", "is not a directory"),
        ("recording.directory", "{loop}", "Too many levels of symbolic links"),
        ("recording.directory", "/tmp/" + "x" * 300, "File name too long"),
        ("control.socket", "{file}", "something else is there"),
        ("control.socket", "/nowhere/c.sock", "its directory does not exist"),
        ("control.socket", "/tmp/" + "x" * 200, "a path of at most 107 bytes"),
        ("web.certificate", "/nowhere/c.pem", "No such file or directory"),
        ("web.certificate", "{file}", "PEM"),
    ],
)
def test_a_place_that_serve_would_refuse_is_found_by_check(
    cli: Cli, rig_file: Path, key: str, value: str, words: str
) -> None:
    loop = rig_file.with_name("loop")
    loop.symlink_to(loop)
    table, name = key.split(".")
    value = value.format(file=rig_file, loop=loop)
    more = f'\nkey = "{value}"' if name == "certificate" else ""
    lines = f'[{table}]\n{name} = "{value}"{more}\n'
    text = rig_file.read_text()
    rig_file.write_text(text.replace(f"[{table}]\n", lines) if f"[{table}]\n" in text else text + lines)
    answer = cli("config", "check", rig_file)
    assert answer.code == 2
    assert words in answer.err
    assert "  try: " in answer.err


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b'name = "\xe9"', "byte 8 is not UTF-8\n  possible: text in UTF-8"),
        (b"stages = ", "Invalid value (at end of document)\n  try: a file as"),
        (b"stages = " + b"9" * 5000, "not TOML: it holds a number of thousands of digits\n  try: a file as"),
    ],
)
def test_what_is_no_toml_is_refused_with_advice(cli: Cli, rig_file: Path, content: bytes, words: str) -> None:
    rig_file.write_bytes(content)
    assert words in cli("config", "check", rig_file).err


def test_a_link_to_nowhere_is_named_as_one(cli: Cli, rig_file: Path) -> None:
    link = rig_file.with_name("link.toml")
    for target in ("absent.toml", link.name):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        assert f"is a link to '{target}', which leads to no file" in cli("config", "check", link).err


def test_a_directory_is_not_a_file(cli: Cli, tmp_path: Path) -> None:
    assert "is a directory" in cli("config", "check", tmp_path).err


def test_setting_below_a_value_is_refused(rig_file: Path) -> None:
    with pytest.raises(ConfigError, match="'name' is a value"):
        load_rig(rig_file, {"name.first": 1})


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("geometry.stagess=4", "--set geometry.stagess: unknown key; did you mean 'stages'?"),
        ("stages=4", "--set stages: unknown key; did you mean 'geometry.stages'?"),
        ("trigger.stages=4", "--set trigger.stages: unknown key; did you mean 'geometry.stages'?"),
        ("geometri.stages=4", "--set geometri: unknown key; did you mean 'geometry'?"),
        ("geometry.stages=0", "--set geometry.stages = 0: "),
        ("geometry=4", "--set geometry = 4: a table is expected"),
        ("=4", "setting '=4' has no key"),
        ("geometry.=4", "setting 'geometry.=4' has no key"),
    ],
)
def test_a_mistake_in_a_setting_is_not_told_as_one_of_the_file(
    cli: Cli, rig_file: Path, tmp_path: Path, setting: str, told: str
) -> None:
    """The error named the file alone, and no key that was meant."""
    out = tmp_path / "x.zarr"
    answer = cli("simulate", "scene-leds", "--config", rig_file, "--out", out, "--set", setting)
    assert (answer.code, told in answer.err, out.exists()) == (2, True, False), answer.err
    assert f"{rig_file}: 1 error" not in answer.err


def test_an_override_of_a_script_is_named_as_one(rig_file: Path) -> None:
    with pytest.raises(ConfigError, match=r"with override: 1 error\n  override geometry\.stagess: unknown"):
        load_rig(rig_file, {"geometry.stagess": 4})


@pytest.mark.parametrize("content", ["", "# only a comment\n\n"], ids=["empty", "comments"])
@pytest.mark.parametrize(
    ("load", "model"),
    [
        (load_rig, "acquire config show rig-demo"),
        (load_scene, "a copy of .*/scene-leds.toml"),
        (load_plan, "a copy of .*/plan-window.toml"),
    ],
    ids=["rig", "scene", "plan"],
)
def test_a_file_without_keys_is_refused_with_a_model(
    tmp_path: Path, content: str, load: Callable[[Path], object], model: str
) -> None:
    """The keys that are missing were listed, and where to find a file that has them was not."""
    file = tmp_path / "new.toml"
    file.write_text(content)
    with pytest.raises(ConfigError, match="has no keys: it is empty, or holds nothing but") as refused:
        load(file)
    assert re.search(model, refused.value.hint)
