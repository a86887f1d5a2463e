"""Recordings through a GenTL producer and GigE Vision: on disk is Eq. (1), and what is missing is told."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gige_helpers import BadLink
from waiting import until

from acquire.config import RigConfig, load_rig, load_scene
from acquire.daemon.plan import Run
from acquire.errors import ConfigError
from acquire.geometry import Geometry
from acquire.lines import LineFlag, merged
from acquire.rig import Rig
from acquire.sim.gige.camera import Transmission
from acquire.sim.lines import StreamingArm
from acquire.simulate import bench_of
from acquire.store import Recording, RunCondition, open_recording, verify
from acquire.stream.messages import Begin

needs_compiler = pytest.mark.needs_compiler

STAGES = 16

SMALL: dict[str, Any] = {
    "geometry.stages": STAGES,
    "recording.chunk_lines": 1024,
    "stream.block_lines": 128,
    "stream.ring_slots": 512,
    "simulation.speed": 0.25,  # a ring of eight seconds: a busy machine loses only what a test takes
}


UNHURRIED = {"simulation.speed": 0.25}
"""So that a busy machine keeps up, and no frame is lost but those that are meant to be."""


def rig_config(**changes: Any) -> RigConfig:
    settings = [
        ["remote", "Width", STAGES],
        ["remote", "PixelFormat", "Mono12Packed"],
        ["remote", "CounterEventSource", "LineTriggerMissed"],
        ["stream", "BufferHeight", 100],
    ]
    given = SMALL | changes
    given |= {f"cameras.{arm}.settings": settings for arm in "ab"}
    return load_rig("rig-demo-gentl", given)


def record(
    config: RigConfig,
    path: Path,
    lines: int,
    happen: Callable[[Rig, Run], None] = lambda rig, run: None,
    stamps: bool = True,
    prepare: Callable[[Rig], None] = lambda rig: None,
) -> tuple[Recording, Any]:
    with Rig(config) as rig:
        prepare(rig)
        run = Run(config, rig)
        try:
            run.arm()
            if stamps:
                until(
                    lambda: all(run.capture.poll().lines[arm]["clock"]["stamp_ns"] for arm in "ab"),
                    "time stamps",
                )
            run.capture.start(Begin(path, run.spec(), lines))
            happen(rig, run)
            until(lambda: run.capture.poll().done, "the recording's end")
        finally:
            run.capture.close()
        return open_recording(path), run.capture.poll()


def check_lines(config: RigConfig, recording: Recording, arm: str) -> np.ndarray:
    """Every row that is not flagged is Eq. (1) of scene and code; returns the flags."""
    stream = recording.camera(arm)
    flags = np.asarray(stream.flags[:])
    with Rig(config) as rig:
        light = StreamingArm(rig.scene(), config.code.build(), STAGES, 3, arm)
        expected = np.clip(np.rint(light.lines(recording.first_line, len(flags)) * np.float32(6.0)), 0, 4095)
    good = flags & (LineFlag.MISSING | LineFlag.INCOMPLETE) == 0
    np.testing.assert_array_equal(np.asarray(stream.lines[:])[good], expected[good])
    return flags


@needs_compiler
def test_what_is_recorded_through_the_producer_is_eq1(tmp_path: Path) -> None:
    config = rig_config()
    recording, status = record(config, tmp_path / "r.zarr", 5000)
    assert status.condition is RunCondition.GOOD, status.ledger
    for arm in "ab":
        assert not check_lines(config, recording, arm).any()
        camera = recording.attrs["cameras"][arm]
        assert (camera["PixelFormat"], camera["BufferHeight"]) == ("Mono12Packed", 100)
        assert camera["identity"]["serial"] == f"SIM-{arm.upper()}"
        assert abs(camera["clock"]["drift_ppb"]) < 1000, "the simulated cameras' clock is the trigger's"
        assert camera["clock"]["stamp_ns"] > 0


def gige_config(**changes: Any) -> RigConfig:
    settings = [
        ["remote", "Width", STAGES],
        ["remote", "PixelFormat", "Mono12"],
        ["remote", "Height", 100],
        ["stream", "packet-resend", "never"],
    ]
    given = SMALL | {f"cameras.{arm}.settings": settings for arm in "ab"}
    return load_rig("rig-demo-gige", given | changes)


@pytest.mark.needs_aravis
def test_what_is_recorded_through_gige_vision_is_eq1(tmp_path: Path) -> None:
    config = gige_config()
    recording, status = record(config, tmp_path / "r.zarr", 5000)
    assert status.condition is RunCondition.GOOD
    for arm in "ab":
        assert not check_lines(config, recording, arm).any()
        camera = recording.attrs["cameras"][arm]
        assert camera["identity"]["serial"] == f"SIM-{arm.upper()}"
        assert (camera["packet-resend"], camera["frame-retention"]) == ("never", 100_000)


@pytest.mark.needs_aravis
def test_over_a_bad_link_every_line_is_eq1_flagged_or_lost_also_after_the_camera_was_away(
    tmp_path: Path,
) -> None:
    config = gige_config(**{"stream.reopen_s": 30.0})

    def prepare(rig: Rig) -> None:
        rig.simulated._gige.transmission = Transmission(link=BadLink(0.05), resends=False)

    def happen(rig: Rig, run: Run) -> None:
        until(lambda: run.capture.poll().recorded_lines > 2500, "lines")
        gige = rig.simulated._gige
        gige._servers.pop("a").end(time.monotonic() + 20)
        until(lambda: run.capture.poll().lines["a"]["reopened"] or _reopen(gige, rig), "the camera")

    def _reopen(gige: Any, rig: Rig) -> bool:
        gige.opener("a", rig.simulated.sensor)
        return False

    recording, status = record(config, tmp_path / "r.zarr", 15_000, happen, prepare=prepare)
    assert status.end_reason == "line budget reached"
    for arm in "ab":
        flags = check_lines(config, recording, arm)
        missing = int((flags & LineFlag.MISSING != 0).sum())
        gaps = [gap for gap in recording.gaps if gap.arm == arm]
        assert missing == sum(gap.count for gap in gaps)
        assert {gap.cause for gap in gaps} <= {"id_gap", "incomplete", "device_lost"}
        assert ("device_lost" in {gap.cause for gap in gaps}) == (arm == "a")
        assert (flags & LineFlag.INCOMPLETE != 0).sum() > 300


@pytest.mark.parametrize("rig", ["rig-demo", pytest.param("rig-demo-gentl", marks=needs_compiler)])
def test_both_arms_from_one_camera_are_eq1(tmp_path: Path, rig: str) -> None:
    settings = [["remote", "PixelFormat", "Mono12p"], ["stream", "BufferHeight", 100]]
    given = dict(SMALL)
    given |= {"cameras.layout": "compact", "cameras.b.serial": "SIM-A", "cameras.b.first_column": STAGES + 5}
    both = {f"cameras.{arm}.settings": settings for arm in "ab"}
    config = load_rig(rig, given | (both if "gentl" in rig else {}))
    recording, status = record(config, tmp_path / "r.zarr", 5000, stamps="gentl" in rig)
    assert status.condition is RunCondition.GOOD
    assert recording.attrs["layout"] == "compact"
    for arm in "ab":
        assert not check_lines(config, recording, arm).any()
        assert recording.attrs["cameras"][arm]["Width"] == 2 * STAGES + 5


def test_arms_that_cannot_share_a_camera_are_refused() -> None:
    compact = {"cameras.layout": "compact", "cameras.b.serial": "SIM-A"}
    for changes, words in (
        ({"cameras.layout": "compact"}, "both arms need the same serial"),
        (compact | {"cameras.b.first_column": 63}, "overlap in columns 63 to 63"),
    ):
        with pytest.raises(ConfigError, match=words):
            load_rig("rig-demo", changes)
    with pytest.raises(ConfigError, match="both arms have the camera with serial 'SIM-A'"):
        load_rig("rig-demo-gentl", {"cameras.b.serial": "SIM-A"})


@needs_compiler
def test_faults_of_one_camera_are_gaps_by_cause_and_the_other_arm_is_whole(tmp_path: Path) -> None:
    config = rig_config(**UNHURRIED)

    def happen(rig: Rig, run: Run) -> None:
        memory = rig.simulated._gentl._bench.cameras["SIM-A"]
        frame = memory["FRAMES"] + 40
        for kind, after, count in (("DROP", 0, 2), ("OVERRUN", 20, 3), ("SHORT", 40, 60), ("MISSED", 0, 5)):
            memory.inject(kind, (frame + 60) * 100 + 30 if kind == "MISSED" else frame + after, count)

    recording, status = record(config, tmp_path / "r.zarr", 20_000, happen)
    lost = {cause: lines for cause, lines in status.lines["a"]["lost"].items() if lines}
    assert lost == {"id_gap": 200, "no_buffer": 300, "incomplete": 40, "missed_trigger": 5}
    gaps = {gap.cause: gap.count for gap in recording.gaps if gap.arm == "a"}
    assert gaps == lost
    flags = check_lines(config, recording, "a")
    assert int((flags & LineFlag.MISSING != 0).sum()) == 545
    assert not check_lines(config, recording, "b").any()


@needs_compiler
def test_a_camera_that_was_away_goes_on_at_the_right_line_and_the_gap_is_recorded(tmp_path: Path) -> None:
    # Six seconds, so that it is away and back before the end also where this test waits for a processor.
    config = rig_config(**{"stream.reopen_s": 20.0, "simulation.speed": 0.1})

    def happen(rig: Rig, run: Run) -> None:
        until(lambda: run.capture.poll().recorded_lines > 1000, "lines")
        memory = rig.simulated._gentl._bench.cameras["SIM-A"]
        memory.unplug()
        until(
            lambda: memory["SESSION"] == memory["ACK"] and not memory["SESSION"] & 1, "the driver to let go"
        )
        memory.plug()

    recording, status = record(config, tmp_path / "r.zarr", 20_000, happen)
    (gap,) = [gap for gap in recording.gaps if gap.arm == "a"]
    assert gap.cause == "device_lost"
    assert status.lines["a"]["lost"]["device_lost"] == gap.count > 0
    flags = check_lines(config, recording, "a")
    missing = np.flatnonzero(flags & LineFlag.MISSING)
    assert (missing[0] + recording.first_line, len(missing)) == (gap.first_line, gap.count)
    assert not check_lines(config, recording, "b").any()


@needs_compiler
def test_a_camera_that_does_not_come_back_ends_the_recording_in_time(tmp_path: Path) -> None:
    config = rig_config(**{"stream.reopen_s": 0.5})

    def happen(rig: Rig, run: Run) -> None:
        until(lambda: run.capture.poll().recorded_lines > 1000, "lines")
        rig.simulated._gentl._bench.cameras["SIM-A"].unplug()
        begin = time.monotonic()
        until(lambda: run.capture.poll().done, "the end")
        assert time.monotonic() - begin < 200

    recording, status = record(config, tmp_path / "r.zarr", 10_000_000, happen)
    assert status.condition is RunCondition.INTERRUPTED
    assert "SIM-A is gone" in status.end_reason
    check_lines(config, recording, "a")


@needs_compiler
def test_the_demo_runs_through_the_producer(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    command = ["demo", f"--out={out}", "--cameras=gentl", "--lines=2200", "--budget=2", "--twist-budget=1"]
    done = subprocess.run(
        [sys.executable, "-m", "acquire", *command, "--json"],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["capture"]["condition"] == "GOOD"
    assert summary["capture"]["lost_lines"] == 0
    cameras = open_recording(out / "recording.zarr").attrs["cameras"]
    assert [cameras[arm]["TriggerMode"] for arm in "ab"] == ["On", "On"]


BUILT = {"geometry.stages": 24, "geometry.substeps": 1, "simulation.speed": 0.08}
"""24 stages whose charge moves once a line, a line start at every sub-step of 10 us."""


def built_matches(config: RigConfig, recording: Recording) -> None:
    """Raw lines merged 3 x 3 are, bit for bit, what the simulator's merging camera gives."""
    first = -(-recording.first_line // 3) * 3
    count = (recording.first_line + recording.lines - first) // 3
    segment = merged(recording.cut(first, 3 * count), 3)
    assert segment.geometry == Geometry(8, 3, count)
    emulated = {"geometry.stages": 8, "simulation.scene": "scene-leds-emulated", "trigger.substep_ticks": 900}
    cameras = {f"cameras.{arm}.responsivity_dn": 6.0 for arm in "ab"}
    rig = load_rig("rig-emulated", emulated | cameras)
    bench = bench_of(rig, load_scene("scene-leds-emulated"))
    for number, arm in enumerate("ab"):
        expected = bench.camera(arm, config.code.build()).read(first // 3, count).pixels
        np.testing.assert_array_equal(segment.lines[number], expected)
    assert segment.mask.all()


@needs_compiler
def test_the_built_setup_through_the_producer(tmp_path: Path) -> None:
    settings = [
        ["remote", "Width", 24],
        ["remote", "PixelFormat", "Mono12Packed"],
        ["stream", "BufferHeight", 100],
    ]
    config = load_rig("rig-demo-gentl", SMALL | BUILT | {f"cameras.{arm}.settings": settings for arm in "ab"})
    recording, status = record(config, tmp_path / "r.zarr", 3000)
    assert status.condition is RunCondition.GOOD
    assert recording.attrs["trigger"]["line_period_ticks"] == 900
    built_matches(config, recording)
    assert verify(tmp_path / "r.zarr").intact


@pytest.mark.needs_aravis
def test_the_built_setup_through_gige_vision(tmp_path: Path) -> None:
    settings = [["remote", "Width", 24], ["remote", "PixelFormat", "Mono12"], ["remote", "Height", 100]]
    config = gige_config(**BUILT | {f"cameras.{arm}.settings": settings for arm in "ab"})
    recording, status = record(config, tmp_path / "r.zarr", 3000)
    assert status.condition is RunCondition.GOOD
    built_matches(config, recording)


FIBRE: dict[str, Any] = {
    "geometry.stages": 16,
    "geometry.substeps": 1,
    "cameras.layout": "fibre",
    "fibre.rows": 32,
    "fibre.columns": 48,
    "fibre.sensor_pixels": 104,
    "simulation.speed": 0.08,
    "trigger.tag_every_lines": 32,  # lines are confirmed by the tag behind them, which the end waits for
}
"""2 x 3 tiles of 16 pixels, side by side on two sensors that are wider than they have stages."""


def fibre_matches(config: RigConfig, recording: Recording) -> None:
    """Whole lines are, bit for bit, what the simulator gives; and tiles are cut from them."""
    assert recording.fibre is not None
    bench = bench_of(config, load_scene("scene-leds"))
    lines, usable = recording.whole_lines(recording.first_line, recording.lines)
    for number, arm in enumerate("ab"):
        camera = bench.camera(arm, config.code.build())
        expected = camera.read(recording.first_line, recording.lines).pixels
        assert expected.shape[1] == 104
        np.testing.assert_array_equal(lines[number], expected)
    assert usable.all()
    assert len(recording.fibre.tiles) == 6
    for tile in recording.fibre.tiles:
        assert recording.cut(recording.first_line, 100, tile).geometry == Geometry(16, 1, 100)


@needs_compiler
def test_a_fibre_through_the_producer(tmp_path: Path) -> None:
    settings = [
        ["remote", "Width", 104],
        ["remote", "PixelFormat", "Mono12Packed"],
        ["stream", "BufferHeight", 100],
    ]
    config = load_rig("rig-demo-gentl", SMALL | FIBRE | {f"cameras.{arm}.settings": settings for arm in "ab"})
    recording, status = record(config, tmp_path / "r.zarr", 3000)
    assert status.condition is RunCondition.GOOD, status.lines
    fibre_matches(config, recording)
    assert verify(tmp_path / "r.zarr").intact


@pytest.mark.needs_aravis
def test_a_fibre_through_gige_vision(tmp_path: Path) -> None:
    settings = [["remote", "Width", 104], ["remote", "PixelFormat", "Mono12"], ["remote", "Height", 100]]
    config = gige_config(**FIBRE | {f"cameras.{arm}.settings": settings for arm in "ab"})
    recording, status = record(config, tmp_path / "r.zarr", 3000)
    assert status.condition is RunCondition.GOOD, [event.text for event in recording.events]
    fibre_matches(config, recording)
