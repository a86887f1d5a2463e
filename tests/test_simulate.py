"""Simulation of a recording without a daemon, and the study of its effects."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import xarray
from PIL import Image

from acquire.config import load_rig, load_scene
from acquire.errors import UsageError
from acquire.sim.effects import kinds
from acquire.sim.functions import FunctionSceneConfig
from acquire.sim.leds import LedSceneConfig
from acquire.sim.lines import StreamingArm
from acquire.sim.scenes import build_scene
from acquire.simulate import MOST_SIMULATED_LINES, bench_of, simulate, study
from acquire.store import open_recording

RIG = load_rig("rig-demo", {"geometry.stages": 8, "recording.chunk_lines": 256})
LEDS = load_scene("scene-leds")


def listed(*kinds, scene=LEDS):
    measured = {effect.kind: effect for effect in load_scene("scene-leds-measured").effects}
    table = scene.model_dump(mode="json")
    table["effects"] = [kind if isinstance(kind, dict) else measured[kind].model_dump() for kind in kinds]
    return LedSceneConfig.model_validate(table)


def test_a_simulated_recording_is_equation_1_with_its_code_and_time(tmp_path):
    seen = []
    done = simulate(RIG, LEDS, tmp_path / "r.zarr", 2500, lambda *progress: seen.append(progress))
    assert (seen[-1], done.lost_lines) == ((2500, 2500), {"a": 0, "b": 0})
    recording = open_recording(tmp_path / "r.zarr")
    assert (recording.lines, recording.first_line, recording.attrs["run_condition"]) == (2500, 0, "GOOD")
    assert recording.attrs["effects"] == []
    code = RIG.code.build()
    scene = build_scene(LEDS, 24, 1e-5)
    segment = recording.cut(1700, 263)
    np.testing.assert_array_equal(segment.code, code.bits(3 * 1700, segment.geometry.span))
    for arm, lines in zip("ab", segment.lines, strict=True):
        Y = StreamingArm(scene, code, 8, 3, arm).lines(1700, 263)
        np.testing.assert_array_equal(lines, np.rint(6 * Y))
    opened = xarray.open_zarr(tmp_path / "r.zarr", group="b")
    assert np.diff(opened.time.values).astype(int).min() >= 29_999


def test_blocks_read_ahead_by_two_threads_are_those_of_one(tmp_path):
    """State kept between blocks (frames, tiles, charge) is never used by two threads at once."""
    window = {"kind": "window", "phases": [{"duration_s": 7e-3, "axis": "row"}]}
    table = listed("shot_noise", "cti").model_dump(mode="json") | {"shutters": [window]}
    scene = LedSceneConfig.model_validate(table)
    simulate(RIG, scene, tmp_path / "r.zarr", 6000)
    stored = open_recording(tmp_path / "r.zarr")
    for arm in "ab":
        alone = bench_of(RIG, scene).camera(arm, RIG.code.build()).read(0, 6000).pixels
        np.testing.assert_array_equal(stored.camera(arm).read("lines", 0, 6000), alone)


def test_dropped_lines_are_flagged_and_listed(tmp_path):
    scene = listed({"kind": "dropped_lines", "rate": 0.05})
    done = simulate(RIG, scene, tmp_path / "r.zarr", 1500)
    recording = open_recording(tmp_path / "r.zarr")
    assert recording.attrs["run_condition"] == "INCOMPLETE"
    for arm in "ab":
        flags = recording.camera(arm).read("flags", 0, 1500)
        assert done.lost_lines[arm] == (flags & 1).sum() > 30
        gaps = [gap for gap in recording.gaps if gap.arm == arm]
        assert sum(gap.count for gap in gaps) == done.lost_lines[arm]
        assert all((flags[gap.first_line : gap.first_line + gap.count] & 1).all() for gap in gaps)


def test_effects_and_their_order_and_the_layout_are_recorded(tmp_path):
    scene = listed("read_noise", "pwm", "beam_splitter")
    scene = scene.model_copy(update={"optics": scene.optics.model_copy(update={"layout": "compact"})})
    simulate(RIG, scene, tmp_path / "r.zarr", 10)
    attrs = open_recording(tmp_path / "r.zarr").attrs
    assert [effect["kind"] for effect in attrs["effects"]] == ["pwm", "beam_splitter", "read_noise"]
    assert (attrs["layout"], attrs["effects"][2]["sigma_e"]) == ("compact", 25.0)


def test_a_refusal_leaves_nothing_and_a_later_failure_a_sealed_recording(tmp_path, monkeypatch):
    out = tmp_path / "r.zarr"
    with pytest.raises(UsageError, match="0 lines"):
        simulate(RIG, LEDS, out, 0)
    with pytest.raises(UsageError, match="1 to 10000000000"):
        simulate(RIG, LEDS, out, MOST_SIMULATED_LINES + 1)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "turns_bad.py").write_text(
        "import numpy as np\n"
        "def always(t, row, column):\n    return -np.ones((len(t), row.size, column.size))\n"
        "def later(t, row, column):\n    return np.where(t[:, None, None] < 0.02, 1, -1) + 0 * row * column\n"
    )
    with pytest.raises(UsageError, match="0 or more"):
        simulate(RIG, FunctionSceneConfig(kind="function", function="turns_bad:always"), out, 10)
    assert not out.exists()
    with pytest.raises(UsageError, match="0 or more"):
        simulate(RIG, FunctionSceneConfig(kind="function", function="turns_bad:later"), out, 4000)
    recording = open_recording(out)
    assert recording.attrs["run_condition"] == "ABORTED"
    assert "function later" in recording.attrs["end_reason"]


def test_an_interrupted_simulation_is_sealed_with_its_lines(tmp_path):
    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(RIG, LEDS, tmp_path / "r.zarr", 5000, interrupt)
    recording = open_recording(tmp_path / "r.zarr")
    assert (recording.lines, recording.attrs["run_condition"]) == (1024, "INTERRUPTED")


def test_the_study_ranks_effects_by_their_influence():
    scene = listed(
        "shot_noise", {"kind": "read_noise", "sigma_e": 0.01}, {"kind": "beam_splitter", "part_a": 0.4}
    )
    found = study(bench_of(RIG, scene), RIG.code.build())
    worth = {one.effect: one for one in found.effects}
    assert [one.effect for one in found.effects] == [k for k in kinds() if k in worth]
    assert worth["read_noise"].noises < 0.1
    assert worth["beam_splitter"].noises > 1
    lines = [
        bench_of(RIG, LEDS).camera(arm, RIG.code.build()).read(600, 512).pixels.astype(float) for arm in "ab"
    ]
    change = np.sqrt(np.mean([(0.2 * one) ** 2 for one in lines]))
    assert worth["beam_splitter"].change_dn == pytest.approx(change, rel=0.1)
    shot_dn = np.sqrt(0.1 * np.mean(lines))
    assert worth["shot_noise"].change_dn == pytest.approx(shot_dn, rel=0.1)
    assert found.noise_dn == pytest.approx(np.sqrt(shot_dn**2 + 1 / 12), rel=0.1)
    assert study(bench_of(RIG, LEDS), RIG.code.build()).effects == ()


@pytest.mark.parametrize("sigma_dn", [0.0, 0.5, 3.0])
def test_the_noise_of_a_study_counts_rounding_once(sigma_dn):
    noise = [{"kind": "read_noise", "sigma_e": sigma_dn / LEDS.system_gain_dn_per_e}] if sigma_dn else []
    camera = RIG.cameras.a.model_copy(update={"black_level_dn": 100.0})
    cameras = RIG.cameras.model_copy(update={"a": camera, "b": camera})
    bench = bench_of(RIG.model_copy(update={"cameras": cameras}), listed(*noise))
    found = study(bench, RIG.code.build(), 4096)
    assert found.noise_dn == pytest.approx(np.sqrt(sigma_dn**2 + 1 / 12), rel=0.03)


def acquire(*words):
    return subprocess.run(
        [sys.executable, "-m", "acquire", "simulate", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_one_command_makes_a_recording_of_a_users_animation_or_says_why_not(tmp_path):
    frames = [Image.fromarray(np.full((30, 40), grey, np.uint8)) for grey in (50, 250)]
    frames[0].save(tmp_path / "user.gif", save_all=True, append_images=frames[1:], duration=20, loop=0)
    small = ("--set", "geometry.stages=8", "--lines", "40", "--json")
    done = acquire(tmp_path / "user.gif", "--out", tmp_path / "r.zarr", *small)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["lines"] == 40
    assert open_recording(tmp_path / "r.zarr").camera("a").read("lines", 20, 30).any()
    (tmp_path / "bad.gif").write_bytes(b"GIF89a nothing")
    refused = acquire(tmp_path / "bad.gif", "--out", tmp_path / "bad.zarr", *small)
    assert refused.returncode == 2
    assert "bad.gif" in refused.stderr
    assert not (tmp_path / "bad.zarr").exists()


def test_explain_shows_every_stage(tmp_path):
    done = acquire("scene-leds-measured", "--explain", "--set", "geometry.stages=8")
    assert done.returncode == 0, done.stderr
    for effect in load_scene("scene-leds-measured").effects:
        assert done.stdout.count(effect.kind) == 2
    assert "us per line" in done.stdout
