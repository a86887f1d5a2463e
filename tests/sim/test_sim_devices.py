"""Simulated cameras at the end of a wire, with a manual clock and in separate processes."""

from __future__ import annotations

import multiprocessing
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_helpers import (
    CODE,
    LEDS,
    PATIENCE_S,
    ManualClock,
    Pulses,
    blas_child,
    camera_child,
    camera_config,
    naive_lines,
    optics,
    read_lines,
    trigger_run,
)

from acquire.codes import ConstantCode
from acquire.config import GeometryConfig
from acquire.config.device import TriggerConfig
from acquire.errors import CameraError
from acquire.sim.clock import Wire
from acquire.sim.compact import SideBySideOpener
from acquire.sim.devices import SimulatedCamera, SimulatedCameraOpener, SimulatedOptics
from acquire.sim.effects.stream import DroppedLines
from acquire.sim.pipeline import Bench
from acquire.sim.scenes import build_scene
from acquire.sim.trigger_model import TriggerModel
from acquire.sim.twin_links import TwinTransport
from acquire.trigger.driver import TriggerDriver

LINE_NS = 30_000
LINE_RATE_HZ = 1e9 / LINE_NS
M, S, DEPTH = 4, 3, 5


@pytest.fixture
def clock():
    return ManualClock()


@pytest.fixture
def wire(clock):
    wire = Wire(clock)
    yield wire
    wire.close()


@pytest.fixture
def trigger(wire):
    return Pulses(wire)


def camera(wire, arm="a", block_lines=8, **config):
    return SimulatedCamera(wire, optics(arm), camera_config(**config), block_lines, LINE_RATE_HZ)


def expected_dn(arm, pulses, code=CODE, substep_s=1e-5, first_pulse=0):
    scene = build_scene(LEDS, M * S, substep_s)
    Y = naive_lines(scene, code, M, S, arm, range(first_pulse - DEPTH, pulses - DEPTH))
    return np.clip(np.rint(5.0 + 40.0 * Y), 0, 4095)


# a camera


def test_a_camera_must_be_armed(wire):
    with pytest.raises(CameraError, match="not armed"):
        camera(wire).next_block(0.1)


def test_settings_are_read_back_under_sfnc_names(wire):
    settings = camera(wire, pixel_format="Mono10").settings()
    assert (settings["TriggerSelector"], settings["TriggerMode"]) == ("LineStart", "On")
    assert settings["AcquisitionLineRate"] == pytest.approx(33_333.3, abs=0.1)
    assert (settings["Width"], settings["PixelFormat"], settings["white_dn"]) == (4, "Mono10", 1023)
    assert (settings["black_level_dn"], settings["responsivity_dn"]) == (5.0, 40.0)
    assert camera(wire, serial="S-1").identify().serial == "S-1"


def test_blocks_come_whole_and_only_when_their_pulses_were_issued(wire, clock, trigger):
    eye = camera(wire)
    eye.arm()
    assert eye.next_block(0.01) is None, "no trigger, no lines"
    trigger.start()
    begin_ns = clock.now_ns
    block = eye.next_block(1.0)
    assert (block.first_line, len(block.pixels), block.pixels.dtype) == (0, 8, np.uint16)
    assert clock.now_ns - begin_ns >= 7 * LINE_NS
    clock.now_ns = begin_ns + 14 * LINE_NS
    assert eye.next_block(0) is None, "pulse 15 is still to come"
    clock.now_ns += LINE_NS
    assert eye.next_block(0).first_line == 8


@given(
    block_lines=st.integers(1, 40),
    pulses=st.integers(1, 90),
    arm=st.sampled_from("ab"),
    looks=st.lists(st.integers(0, 30), max_size=4),
)
@settings(max_examples=40, deadline=None)
def test_a_stop_leaves_exactly_the_issued_lines_however_they_are_blocked(block_lines, pulses, arm, looks):
    clock = ManualClock()
    wire = Wire(clock)
    trigger, eye = Pulses(wire), camera(wire, arm, block_lines)
    eye.arm()
    trigger.start()
    blocks = []
    for lines in looks:
        clock.now_ns = min(clock.now_ns + lines * LINE_NS, wire.read().train.due_ns(pulses - 1))
        blocks += [block.pixels for block in [eye.next_block(0)] if block is not None]
    clock.now_ns = max(clock.now_ns, wire.read().train.due_ns(pulses - 1))
    assert trigger.stop() == pulses
    while (block := eye.next_block(0.001)) is not None:
        blocks.append(block.pixels)
    assert all(len(block) == block_lines for block in blocks[:-1])
    np.testing.assert_array_equal(np.concatenate(blocks), expected_dn(arm, pulses))
    assert eye.statistics() == {"lines": pulses, "lost": 0, "behind_lines": 0}
    wire.close()


def test_nothing_spins_after_the_last_line(wire, clock, trigger):
    eye = camera(wire)
    eye.arm()
    trigger.start()
    trigger.stop()
    assert len(read_lines(eye, 1)) == 1
    begin_ns = clock.now_ns
    assert eye.next_block(0.5) is None
    assert clock.now_ns - begin_ns == pytest.approx(0.5e9, rel=1e-3)


def test_code_and_timing_come_with_the_pulses(wire, clock, trigger):
    eye = camera(wire)
    eye.arm()
    trigger.start(code=ConstantCode(1), substep_ticks=4500)
    clock.now_ns += 39 * 5 * LINE_NS
    trigger.stop()
    dn = np.concatenate(read_lines(eye, 40))
    np.testing.assert_array_equal(dn, expected_dn("a", 40, ConstantCode(1), substep_s=5e-5))


def test_a_late_camera_delivers_everything_and_reports_how_late_it_is(wire, clock, trigger):
    eye = camera(wire)
    eye.arm()
    trigger.start()
    clock.now_ns += 999 * LINE_NS
    assert eye.statistics() == {"lines": 0, "lost": 0, "behind_lines": 1000}
    eye.next_block(0)
    assert eye.statistics() == {"lines": 8, "lost": 0, "behind_lines": 992}


@pytest.mark.parametrize(("pixel_format", "white", "dtype"), [("Mono8", 255, "u1"), ("Mono12", 4095, "u2")])
def test_the_converter_rounds_and_clips(wire, clock, trigger, pixel_format, white, dtype):
    eye = camera(wire, pixel_format=pixel_format, responsivity_dn=200.0)
    eye.arm()
    trigger.start(code=ConstantCode(1))
    clock.now_ns += 39 * LINE_NS
    dn = np.concatenate(read_lines(eye, 40))
    assert dn.dtype == dtype
    assert (dn.min(), dn.max()) == (5, white)


def test_arms_side_by_side_stay_on_the_same_line_when_lines_are_lost(wire, clock, trigger):
    scene = LEDS.model_copy(update={"effects": (DroppedLines(kind="dropped_lines", rate=0.03),)})
    geometry = GeometryConfig(stages=M, substeps=S)
    openers = tuple(
        SimulatedCameraOpener(wire, SimulatedOptics(arm, geometry, scene), camera_config(), 64, LINE_RATE_HZ)
        for arm in "ab"
    )
    bench = Bench(scene, geometry, dict.fromkeys("ab", camera_config()), 1e-5)
    a, b = (bench.camera(arm, CODE).read(-DEPTH, 1000) for arm in "ab")
    pulses = int(np.flatnonzero(a.missing | b.missing)[-1]) + 1  # the last line is lost
    one = SideBySideOpener(openers, (1, 6), 11)()
    one.arm()
    trigger.start()
    clock.now_ns += (pulses - 1) * LINE_NS
    assert trigger.stop() == pulses
    seen = {}
    for _ in range(200):
        if (block := one.next_block(0.01)) is not None:
            assert not block.pixels[:, [0, 5, 10]].any()
            assert block.first_line > max(seen, default=-1)
            seen |= dict(enumerate(block.pixels, block.first_line))
    kept = np.flatnonzero(~(a.missing | b.missing)[:pulses])
    assert 900 < len(kept) < 980
    np.testing.assert_array_equal(list(seen), kept)
    lines = np.stack(list(seen.values()))
    np.testing.assert_array_equal(lines[:, 1:5], a.pixels[kept])
    np.testing.assert_array_equal(lines[:, 6:10], b.pixels[kept])
    assert one.statistics() == {"lines": len(kept), "lost": pulses - len(kept), "behind_lines": 0}


def test_a_camera_armed_while_pulses_come_counts_from_there(wire, clock, trigger):
    trigger.start()
    clock.now_ns += 20 * LINE_NS
    eye = camera(wire)
    eye.arm()
    clock.now_ns += 8 * LINE_NS
    block = eye.next_block(0)
    assert block.first_line == 0
    np.testing.assert_array_equal(block.pixels, expected_dn("a", 29, first_pulse=21))


def test_a_second_start_under_an_armed_camera_is_an_error_not_a_mixture(wire, clock, trigger):
    eye = camera(wire)
    eye.arm()
    trigger.start()
    trigger.stop()
    trigger.start(run_id="second")
    with pytest.raises(CameraError, match="started train 2 with a camera armed for train 1"):
        eye.next_block(0.1)
    eye.disarm()
    eye.arm()
    assert eye.next_block(0.1).first_line == 0


def test_a_camera_armed_after_a_run_waits_for_the_next(wire, clock, trigger):
    trigger.start()
    clock.now_ns += 100 * LINE_NS
    trigger.stop()
    eye = camera(wire)
    eye.arm()
    assert eye.next_block(0.1) is None
    trigger.start(run_id="second")
    assert eye.next_block(0.1).first_line == 0


# processes of their own


@contextmanager
def spawned(target, *openers):
    context = multiprocessing.get_context("spawn")
    children = []
    try:
        for opener in openers:
            ours, theirs = context.Pipe()
            child = context.Process(target=target, args=(opener, theirs), daemon=True)
            child.start()
            theirs.close()
            children.append((child, ours))
        yield [link for _, link in children]
        for child, _ in children:
            child.join(300)
            assert child.exitcode == 0
    finally:
        for child, link in children:
            child.kill()
            child.join(300)
            link.close()


def received(link):
    assert link.poll(PATIENCE_S), "nothing came from the child"
    return link.recv()


def test_two_cameras_in_separate_processes_follow_one_trigger():
    wire = Wire()
    trigger = TriggerDriver(lambda: TwinTransport(TriggerModel(wire, 90_000_000)), TriggerConfig())
    openers = [SimulatedCameraOpener(wire, optics(arm), camera_config(), 64, LINE_RATE_HZ) for arm in "ab"]
    with spawned(camera_child, *openers) as links:
        assert [received(link) for link in links] == ["armed", "armed"]
        trigger.prepare(trigger_run())
        trigger.start()
        tags = []
        while not tags or tags[-1].line < 4000:  # on a busy host none may have come yet
            tags += trigger.tags(5.0)
        pulses = trigger.stop()
        trigger.close()
        for link in links:
            link.send(pulses)
        results = [received(link) for link in links]
    assert pulses >= 4001
    assert [tag.line for tag in tags] == list(range(0, tags[-1].line + 1, 16))
    for arm, (dn, after, statistics) in zip("ab", results, strict=True):
        assert (len(dn), after) == (pulses, None)
        assert statistics == {"lines": pulses, "lost": 0, "behind_lines": 0}
        np.testing.assert_array_equal(dn[:300], expected_dn(arm, 300))
        np.testing.assert_array_equal(dn[-300:], expected_dn(arm, pulses, first_pulse=pulses - 300))
    wire.close()


def test_a_camera_process_multiplies_on_one_thread():
    wire = Wire()
    with spawned(blas_child, SimulatedCameraOpener(wire, optics("a"), camera_config(), 8, LINE_RATE_HZ)) as (
        link,
    ):
        own_s, others_s = received(link)
    wire.close()
    assert others_s < 0.3 * own_s, "threads of BLAS worked, or span, beside the camera's own"
