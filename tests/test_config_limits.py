"""Malformed rig files, and values that no host can honour, are refused with a sentence by the check."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import ValidationError

from acquire.config import RigConfig, builtin_directory, load_plan, load_recorded, load_rig, load_scene
from acquire.config.files import MOST_FILE_BYTES, parse_settings
from acquire.daemon import host
from acquire.daemon.host import check_host
from acquire.errors import ConfigError

DEEP = "x = " + "[" * 20_000
DIGITS = "9" * 10_000
SENTENCE_CHARACTERS = 6000
"""Of the longest refusal."""


@pytest.fixture
def rig_text() -> str:
    return (builtin_directory() / "rig-demo.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("load", [load_rig, load_scene, load_plan])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (DEEP.encode(), "nested too deeply"),
        (b"x = " + b"[" * 500 + b"]" * 500, "x"),
        (f"x = {DIGITS}".encode(), "not TOML"),
        (b"x = 0x" + b"f" * 40_000, "x"),
        (b"\xff\xfex = 1", "byte 0 is not UTF-8"),
        (b"x = 1\0", "not TOML"),
        (b"#" * (MOST_FILE_BYTES + 1), "larger than"),
        (b"a = 1\n" + b"\n".join(b"k%d = 1" % i for i in range(5000)), " error"),
        (b'x = "' + b"y" * 50_000 + b'"', "x"),
        (b'"' + b"y" * 50_000 + b'" = 1', " error"),
    ],
)
def test_malformed_files_are_refused(
    load: Callable[[Path], object], tmp_path: Path, content: bytes, words: str
) -> None:
    file = tmp_path / "x.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert words in str(caught.value)
    assert len(str(caught.value)) < SENTENCE_CHARACTERS


@pytest.mark.parametrize("key", ["control.socket", "recording.directory"])
def test_a_path_with_a_null_character_is_refused(key: str) -> None:
    with pytest.raises(ConfigError, match=f"{key} = .*: a path cannot contain a null character"):
        load_rig("rig-demo", parse_settings([f'{key}="a\\u0000b"']))


def test_a_block_that_takes_as_long_as_a_stall_is_refused() -> None:
    settings = {"trigger.substep_ticks": 90_000, "stream.block_lines": 500, "stream.reopen_s": 0.0}
    words = (
        r"cannot be 500: at 333\.333 lines/s such a block takes 1\.5 s; possible: up to 333, half the time"
    )
    with pytest.raises(ConfigError, match=words):
        load_rig("rig-demo", settings | {"stream.stall_s": 2.0})
    assert load_rig("rig-demo", settings | {"stream.stall_s": 4.0}).stream.block_lines == 500


def test_tiny_blocks_in_real_time_are_refused() -> None:
    settings = {"stream.realtime": True, "stream.block_lines": 4}
    words = (
        r"cannot be 4 with stream\.realtime: .* 8333 blocks/s .*; possible: 17 or more, or realtime = false"
    )
    with pytest.raises(ConfigError, match=words):
        load_rig("rig-demo", settings)
    assert load_rig("rig-demo", settings | {"stream.block_lines": 17}).stream.block_lines == 17
    assert load_rig("rig-demo", {"stream.block_lines": 4}).stream.block_lines == 4


def test_more_tags_than_the_host_can_read_are_refused() -> None:
    settings = {"trigger.substep_ticks": 900, "trigger.tag_every_lines": 3}
    fewest = r"cannot be 3 at 33333.3 lines/s; possible: 4 or more, since the host reads up to 10000 tags/s"
    with pytest.raises(ConfigError, match=fewest):
        load_rig("rig-demo", settings)
    assert load_rig("rig-demo", settings | {"trigger.tag_every_lines": 4}).trigger.tag_every_lines == 4
    with pytest.raises(ConfigError, match=r"cannot be 4 at 66666\.7 lines/s"):
        load_rig("rig-demo", settings | {"trigger.tag_every_lines": 4, "simulation.speed": 2.0})


@pytest.mark.parametrize(
    "broken",
    [
        {"trigger": {"tag_every_lines": 1}},
        {"stream": {"block_lines": 65_536}},
        {"stream": {"ring_slots": 2, "ring_seconds": None}},
        {"events": {"pre_s": 60.0, "sources": ["input"]}},
    ],
)
def test_limits_of_a_live_capture_do_not_apply_to_the_rig_of_a_recording(
    broken: dict[str, dict[str, object]],
) -> None:
    table = load_rig("rig-demo").model_dump(mode="json")
    for name, changes in broken.items():
        table[name] |= changes
    with pytest.raises(ValidationError, match=r"cannot be|need"):
        RigConfig.model_validate(table)
    attrs = {"config": table, "scene": load_scene("scene-leds").model_dump(mode="json")}
    rig, _ = load_recorded(attrs, "r.zarr")
    assert rig.geometry == load_rig("rig-demo").geometry
    table["fibre"] = {"rows": 64, "columns": 64, "sensor_pixels": 64}
    with pytest.raises(ConfigError, match=r"r\.zarr, as it was recorded"):
        load_recorded(attrs, "r.zarr")


def test_special_files_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    for odd in (tmp_path / "pipe.toml", Path("/dev/zero"), Path("/dev/null")):
        with pytest.raises(ConfigError, match="not a regular file"):
            load_rig(odd)


def test_a_byte_order_mark_is_ignored(tmp_path: Path, rig_text: str) -> None:
    file = tmp_path / "rig.toml"
    file.write_text("\ufeff" + rig_text, encoding="utf-8")
    assert load_rig(file) == load_rig("rig-demo")


def test_a_rig_without_a_scene_gets_the_requested_one(tmp_path: Path) -> None:
    sizes = 'name = "bare"\n[geometry]\nstages = 16\nsubsteps = 2\n'
    bare = sizes + '[cameras.a]\nserial = "A"\n[cameras.b]\nserial = "B"\n'
    (tmp_path / "bare.toml").write_text(bare)
    (tmp_path / "own.toml").write_text(f'{bare}[simulation]\nscene = "scene-digits"\n')
    seen = load_rig(tmp_path / "bare.toml", scene="scene-usaf").simulation.scene
    assert seen == str(builtin_directory() / "scene-usaf.toml")
    seen = load_rig(tmp_path / "own.toml", scene="scene-usaf").simulation.scene
    assert seen == str(builtin_directory() / "scene-digits.toml"), "what the file says goes first"
    with pytest.raises(ConfigError, match="scene is missing"):
        load_rig(tmp_path / "bare.toml")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("geometry.stages", True),
        ("geometry.stages", "64"),
        ("geometry.stages", 64.0),
        ("geometry.substeps", True),
        ("code.seed", True),
        ("code.seed", 1 << 40_000),
        ("trigger.substep_ticks", True),
        ("simulation.speed", True),
        ("recording.commit_s", False),
        ("events.sources", "mark"),
        ("cameras.a.settings", [["remote", "Gain", [1]]]),
        ("name", "x" * 300),
        ("name", "a/b"),
        ("name", "a\n"),
        ("cameras.a.serial", "x" * 5000),
        ("events.post_s", -1.0),
        ("events.post_s", 1e300),
        ("stream.ring_seconds", 1e12),
        ("stream.reopen_s", float("nan")),
        ("trigger.external_timeout_s", 1e12),
        ("recording.reserve_gb", 1e12),
        ("recording.reserve_gb", float("inf")),
        ("recording.retention.hold_before_s", 1e12),
        ("cameras.a.black_level_dn", 1e300),
    ],
    ids=lambda value: value if isinstance(value, str) and len(value) < 50 else type(value).__name__,
)
def test_invalid_values_name_their_key(key: str, value: object) -> None:
    with pytest.raises(ConfigError) as caught:
        load_rig("rig-demo", {key: value})
    assert key in str(caught.value)
    assert len(str(caught.value)) < 500


def test_every_number_has_its_limits() -> None:
    """A number without an upper limit would fail later, where its key is no longer known."""
    open_ended: list[str] = []
    for name, model in RigConfig.model_json_schema()["$defs"].items():
        for key, found in model["properties"].items():
            for kind in found.get("anyOf", [found]):
                bounded = {"maximum", "exclusiveMaximum", "enum", "const"} & set(kind)
                if kind.get("type") in ("integer", "number") and not bounded:
                    open_ended.append(f"{name}.{key}")
    assert open_ended == ["PrbsConfig.degree"]  # one of a list


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"recording.reserve_gb": 1e8}, "recording.reserve_gb = 1e+08: the disk of"),
        ({"recording.directory": "/proc"}, "the disk of /proc has no room at all"),  # it said "below 0"
        ({"recording.retention.max_gb": 1e-12}, "less than one file of each arm; possible:"),
        ({"recording.chunk_lines": 2**20, "geometry.stages": 4096}, "chunk_lines = 1048576; possible: 1 to"),
    ],
)
def test_what_would_fail_at_start_is_refused_at_check(
    tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        check_host(load_rig("rig-demo", {"recording.directory": str(tmp_path)} | changes))
    assert words in str(caught.value)


def test_memory_is_compared_with_that_of_the_host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    changes = {"recording.directory": str(tmp_path), "geometry.stages": 4096, "stream.ring_seconds": 1.0}
    monkeypatch.setattr(host, "memory_bytes", lambda: 64 * 10**9)
    check_host(load_rig("rig-demo", changes))
    monkeypatch.setattr(host, "memory_bytes", lambda: 8 * 10**9)
    with pytest.raises(ConfigError, match=r"geometry.stages = 4096: .* possible: up to 6.4 GB on this host"):
        check_host(load_rig("rig-demo", changes))
    assert 2**28 < host.memory_bytes() < 2**60


def test_a_camera_without_intra_line_steps_gets_none() -> None:
    with pytest.raises(ConfigError, match="moves its charge once per line"):
        load_rig("rig-vt-4k5c-h100", {"geometry.substeps": 3})
    with pytest.raises(ConfigError, match=r"TDIStages is 'TDI192', but geometry\.stages is 64"):
        load_rig("rig-vt-4k5c-h100", {"geometry.stages": 64})
    assert load_rig("rig-vt-4k5c-h100").line_rate_hz == 100_000


FIBRE = {"geometry.stages": 64, "geometry.substeps": 1, "cameras.layout": "fibre"}
FIBRE |= {"fibre.rows": 128, "fibre.columns": 192, "fibre.sensor_pixels": 400}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"cameras.layout": "dual"},
            "[fibre] cannot be used with cameras.layout = 'dual'; possible: 'fibre'",
        ),
        (
            {"cameras.layout": "compact", "cameras.b.serial": "SIM-A"},
            "[fibre] cannot be used with cameras.layout = 'compact'",
        ),
        (
            {"fibre.rows": 100},
            "100 rows is not a whole number of bands of n = 64; possible: a multiple of 64",
        ),
        ({"fibre.sensor_pixels": 383}, "sensor A with 383 columns is too narrow for 2 bands of 192"),
        ({"fibre.bands_b": [0, 100, 256]}, "bands of 128 columns that begin at 0, 100, 256 overlap or"),
        ({"stream.ring_seconds": 1000.0}, "lines of 400 pixels need"),
    ],
)
def test_a_fibre_that_does_not_fit_is_refused(changes: dict[str, object], words: str) -> None:
    assert load_rig("rig-demo", FIBRE).pixels == 400
    with pytest.raises(ConfigError) as caught:
        load_rig("rig-demo", FIBRE | changes)
    assert words in str(caught.value)


def test_a_fibre_needs_its_table() -> None:
    with pytest.raises(ConfigError, match=r"cameras\.layout = 'fibre' needs \[fibre\] with rows, columns"):
        load_rig("rig-demo", {"cameras.layout": "fibre"})


@pytest.mark.parametrize(
    ("setting", "said", "hint"),
    [
        ("recording.directory=/data", "has no valid TOML value", "\"recording.directory='/data'\""),
        ("code.seed=", "has no valid TOML value", ""),
        ("name='lab", "has no valid TOML value", ""),
        ("code.seed", "has no '='", ""),
    ],
)
def test_a_setting_that_is_not_toml_is_shown_corrected(setting: str, said: str, hint: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        parse_settings([setting])
    assert caught.value.hint.endswith(hint)
    assert bool(caught.value.hint) == bool(hint)


@pytest.mark.parametrize("module", ["acquire.config.load_rig", "acquire.sim.media.open_media"])
def test_a_file_in_a_directory_that_may_not_be_entered_is_not_said_to_be_missing(
    tmp_path: Path, module: str
) -> None:
    (tmp_path / "closed").mkdir()
    (tmp_path / "closed" / "file.toml").touch()
    (tmp_path / "closed").chmod(0)
    module, _, function = module.rpartition(".")
    code = (
        f"import os, pathlib; from {module} import {function}; from acquire.errors import UsageError\n"
        "os.geteuid() or os.seteuid(65534)\n"  # root may enter any directory
        f"try: {function}(pathlib.Path({str(tmp_path / 'closed' / 'file.toml')!r}))\n"
        "except UsageError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "does not exist" not in done.stdout
    assert "may not enter" in done.stdout or "Permission denied" in done.stdout


def test_a_complete_rig_file_from_before_replays_had_a_gate_is_read():
    """`config show` wrote every key, also this one, which is gone."""
    assert load_rig("rig-demo", {"simulation.replay_hold_s": 0.0}).name == "demo"
    with pytest.raises(ConfigError, match="replay_hold_s is gone; possible: replay_gate"):
        load_rig("rig-demo", {"simulation.replay_hold_s": 2.0})
