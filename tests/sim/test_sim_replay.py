"""Stored streams through simulated devices: the same lines, the same code, gaps where they were."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from sim_helpers import CODE, ManualClock

from acquire.camera.base import CameraBlock
from acquire.codes import ConstantCode, PrbsCode, mix_seed, prbs, state_at
from acquire.config import load_rig, load_scene
from acquire.errors import CameraError
from acquire.sim.clock import Wire
from acquire.sim.leds import LedSceneConfig
from acquire.sim.replay import ReplayCameraOpener, describe_replay, replay_code
from acquire.simulate import simulate
from acquire.store import open_recording

RIG = load_rig("rig-demo", {"geometry.stages": 8, "recording.chunk_lines": 256})
LINES = 900
DEPTH = 9


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Lines of LEDs with noise, some of them missing."""
    table = load_scene("scene-leds").model_dump(mode="json")
    table["effects"] = [{"kind": "read_noise", "sigma_e": 30}, {"kind": "dropped_lines", "rate": 0.03}]
    path = tmp_path_factory.mktemp("r") / "r.zarr"
    simulate(RIG, LedSceneConfig.model_validate(table), path, LINES)
    return open_recording(path)


def play(stored, pulses, **changes):
    """All blocks of arm b for so many pulses."""
    clock = ManualClock()
    wire = Wire(clock)
    try:
        gate = changes.get("gate")
        camera = ReplayCameraOpener(wire, stored.path, "b", 64, **changes)()
        camera.arm()
        period = stored.line_period_ns
        wire.start(Fraction(period), Fraction(1), CODE.to_attrs())
        clock.now_ns += int((pulses - 1) * period) + 1
        held = camera.next_block(0.0)
        if gate is not None:
            gate.touch()
        else:
            wire.stop()
        blocks: list[CameraBlock] = [held] if held else []
        while (block := camera.next_block(0.1)) is not None:
            blocks.append(block)
        return blocks, camera.statistics(), held
    finally:
        wire.close()


@pytest.mark.parametrize("degree", [3, 7, 23, 64])
def test_a_register_can_be_started_anywhere(degree):
    seed = mix_seed(5, degree)
    for index in (0, 1, 2, degree - 1, degree, degree + 1, 1000, 123_456_789_012):
        bits = prbs(degree, state_at(degree, seed, index), 0, 300)
        np.testing.assert_array_equal(bits, prbs(degree, seed, index, 300))


def test_every_stored_line_comes_back_with_its_number_and_no_other(stored):
    blocks, statistics, _ = play(stored, LINES + DEPTH)
    pixels, flags = (stored.camera("b").read(name, 0, LINES) for name in ("lines", "flags"))
    there = np.flatnonzero((flags & 1) == 0)
    number = np.concatenate([np.arange(len(block.flags)) + block.first_line - DEPTH for block in blocks])
    lines = np.concatenate([block.pixels for block in blocks])
    np.testing.assert_array_equal(number[DEPTH:], there)
    np.testing.assert_array_equal(lines[DEPTH:], pixels[there])
    assert statistics["lost"] == LINES - len(there) > 10
    assert statistics["lines"] == len(there) + DEPTH


def test_a_replay_ends_or_begins_again_with_flags(stored):
    once, _, _ = play(stored, 3 * LINES)
    assert once[-1].first_line + len(once[-1].flags) <= LINES + DEPTH
    assert not any(block.flags.any() for block in once)
    twice, _, _ = play(stored, 2 * LINES + DEPTH, loop=True)
    lines = {
        block.first_line - DEPTH + i: (block.pixels[i], block.flags[i])
        for block in twice
        for i in range(len(block.flags))
    }
    assert max(lines) > 1.9 * LINES
    for number, (pixels, flags) in lines.items():
        if number >= 0:
            assert flags == (16 if number >= LINES else 0)
            np.testing.assert_array_equal(pixels, lines[number % LINES][0])


def test_no_line_comes_before_the_gate_opens_and_dark_ones_come_after_the_last(stored, tmp_path):
    blocks, _, held = play(stored, LINES + DEPTH + 64, gate=tmp_path / "gate")
    assert held is None
    assert blocks[0].first_line == 0
    assert blocks[-1].first_line + len(blocks[-1].flags) == DEPTH + LINES + 64
    assert not blocks[-1].pixels[-64:].any()


def test_the_code_of_a_replay_is_the_stored_one_from_its_first_line_on(stored):
    class Later:
        first_line = 12_345
        attrs = stored.attrs
        geometry_for = staticmethod(stored.geometry_for)

    code = replay_code(Later())
    assert isinstance(code, PrbsCode)
    np.testing.assert_array_equal(code.bits(0, 500), RIG.code.build().bits(3 * 12_345, 500))
    Later.attrs = {"code": ConstantCode(1).to_attrs()}
    assert replay_code(Later()) == ConstantCode(1)
    assert describe_replay(stored.path)["effects"][0]["kind"] == "read_noise"
    assert describe_replay(stored.path)["replayed"]["first_line"] == 0


def test_a_camera_that_is_not_armed_or_armed_late_says_so(stored):
    wire = Wire(ManualClock())
    try:
        camera = ReplayCameraOpener(wire, stored.path, "a", 64)()
        with pytest.raises(CameraError, match="not armed"):
            camera.next_block(0.0)
        wire.start(Fraction(30_000), Fraction(1), CODE.to_attrs())
        with pytest.raises(CameraError, match="trigger is running"):
            camera.arm()
    finally:
        wire.close()
