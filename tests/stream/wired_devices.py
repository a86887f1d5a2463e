"""A trigger and cameras for tests: a shared page is the wire, lines count up, faults are thrown by hand.

Line ``l`` of an arm holds `pixels_of`; it exists once the trigger has issued pulse ``l + depth``.
"""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from acquire.camera.base import CameraBlock, CameraIdentity
from acquire.clock import ClockFit
from acquire.codes import PrbsCode
from acquire.errors import CameraError, TriggerError
from acquire.processes.shared import Counters
from acquire.store import RecordingSpec
from acquire.stream import CapturePlan
from acquire.trigger.base import LineTag, TagEvent, TriggerIdentity, TriggerRun

STAGES, SUBSTEPS, PIXELS, WHITE = 8, 3, 8, 4095
DEPTH = STAGES + 1
CLOCK_HZ = 90_000_000
SUBSTEP_TICKS = 900
FAULTS = ("stall", "drop", "raise", "die", "bug", "stuck")
SATURATED_EVERY = 1000

CODE = PrbsCode(64, 0xACE1)


def make_wire() -> Counters:
    """Zero: not started, not stopped, no fault. ``drop_b`` lets camera b lose its next block, and so on."""
    names = ("start_ns", "stop_ns", *(f"{fault}_{arm}" for fault in FAULTS for arm in "ab"))
    return Counters(names)


def pixels_of(arm: str, lines: np.ndarray) -> np.ndarray:
    """(line, pixel) uint16; one line in a thousand has a white pixel."""
    line = lines[:, None]
    pixels = (line * 7 + np.arange(PIXELS) * 11 + (1 if arm == "b" else 0)) % WHITE
    pixels[lines % SATURATED_EVERY == 0, 3] = WHITE
    return pixels.astype(np.uint16)


def issued(wire: Counters, rate_hz: float) -> int:
    """Pulses until now."""
    if not (start := wire["start_ns"]):
        return 0
    now = wire["stop_ns"] or time.monotonic_ns()
    return int((now - start) * rate_hz / 1e9)


@dataclass(frozen=True)
class CountingOpener:
    """Opens a `CountingCamera`; ``fault`` happens while opening."""

    wire: Counters
    arm: str
    rate_hz: float
    block_lines: int
    fault: str = ""

    def __call__(self) -> CountingCamera:
        if self.fault == "refuse":
            raise CameraError("camera b is in use", possible="another", hint="unplug it")
        if self.fault == "bug":
            raise ZeroDivisionError("a bug")
        if self.fault == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        while self.fault == "hang":
            time.sleep(1)
        return CountingCamera(self)


class CountingCamera:
    def __init__(self, given: CountingOpener) -> None:
        self.given = given
        self.next_line = 0
        self.held = 0

    def identify(self) -> CameraIdentity:
        return CameraIdentity("test", "counting", self.given.arm, "1")

    def settings(self) -> dict[str, Any]:
        return {"Width": PIXELS}

    def arm(self) -> None:
        self.next_line = 0

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        assert self.held == 0, "the block before was not released"
        given = self.given
        deadline = time.monotonic() + timeout_s
        while issued(given.wire, given.rate_hz) < self.next_line + given.block_lines or self._fault("stall"):
            if time.monotonic() > deadline:
                return None
            time.sleep(0.001)
        if self._fault("raise"):
            raise CameraError("the link is down")
        if self._fault("bug"):
            raise ZeroDivisionError("a bug")
        if self._fault("die"):
            os.kill(os.getpid(), signal.SIGKILL)
        if self._fault("drop"):
            given.wire[f"drop_{given.arm}"] = 0
            self.next_line += given.block_lines
        first, self.next_line = self.next_line, self.next_line + given.block_lines
        lines = np.arange(first, self.next_line) - DEPTH
        self.held += 1
        return CameraBlock(first, pixels_of(given.arm, lines), np.zeros(len(lines), np.uint16))

    def release(self, block: CameraBlock) -> None:
        self.held -= 1
        block.pixels[:] = 0  # a reader that kept it would notice

    def disarm(self) -> None:
        if self._fault("stuck"):
            raise CameraError("the camera does not stop", hint="unplug it")

    def statistics(self) -> dict[str, int]:
        return {"lines": self.next_line, "lost": 0}

    def close(self) -> None:
        """Nothing to let go of."""

    def _fault(self, name: str) -> bool:
        return bool(self.given.wire[f"{name}_{self.given.arm}"])


class WireTrigger:
    """Issues pulses at ``rate_hz``, whatever the run's ticks say.

    ``mute``: no tags; ``refuse``: no run; ``hold_up_s``: how long the next wait for tags takes; ``stuck``:
    it does not report how many pulses there were.
    """

    def __init__(self, wire: Counters, rate_hz: float) -> None:
        self.wire = wire
        self.rate_hz = rate_hz
        self.mute = self.refuse = self.stuck = False
        self.hold_up_s = 0.0
        self.broken: Exception | None = None
        self.shift = 0
        self.told: list[TagEvent] = []
        self.stops = 0
        self._next = 0

    def identify(self) -> TriggerIdentity:
        return TriggerIdentity("test", "0", "1", CLOCK_HZ)

    def prepare(self, run: TriggerRun) -> None:
        if self.refuse:
            raise TriggerError("the run is too fast")
        self.run = run
        self._next = 0

    def start(self) -> ClockFit:
        self.wire["start_ns"] = time.monotonic_ns()
        return ClockFit(CLOCK_HZ, 1_700_000_000_000_000_000, 1000)

    def tags(self, timeout_s: float) -> list[LineTag]:
        if self.broken:
            raise self.broken
        if self.mute or self.wire["stop_ns"]:
            return []
        held_s, self.hold_up_s = self.hold_up_s, 0.0
        time.sleep(held_s or timeout_s / 4)
        end = issued(self.wire, self.rate_hz)
        lines = range(self._next, end, self.run.tag_every_lines)
        self._next += len(lines) * self.run.tag_every_lines
        period = self.run.line_period_ticks
        return [LineTag(line, line * SUBSTEPS + self.shift, line * period) for line in lines]

    def events(self) -> list[TagEvent]:
        told, self.told = self.told, []
        return told

    def stop(self) -> int:
        self.stops += 1
        if not self.wire["stop_ns"]:
            self.wire["stop_ns"] = time.monotonic_ns()
        if self.stuck:
            raise TriggerError("the trigger does not answer")
        return issued(self.wire, self.rate_hz)

    def statistics(self) -> dict[str, Any]:
        return {"pulses": issued(self.wire, self.rate_hz), "tags": self._next}

    def close(self) -> None:
        self.stop()


@dataclass
class Bench:
    """Everything for one capture."""

    wire: Counters
    trigger: WireTrigger
    plan: CapturePlan


def make_bench(
    *, rate_hz: float = 20_000, block_lines: int = 256, fault_b: str = "", **changes: Any
) -> Bench:
    """A plan whose cameras' blocks are no multiple of a ring's slots, and wired devices for it."""
    wire = make_wire()
    openers = {arm: CountingOpener(wire, arm, rate_hz, block_lines) for arm in "ab"}
    openers["b"] = replace(openers["b"], fault=fault_b)
    plan = CapturePlan(
        run=TriggerRun("run-1", CODE, SUBSTEPS, SUBSTEP_TICKS, tag_every_lines=100),
        stages=STAGES,
        pixels=PIXELS,
        dtype="uint16",
        block_lines=200,
        ring_slots=1024,  # ten seconds: a busy host's recorder may have to wait for its turn
        white_dn=WHITE,
        openers=openers,
        stall_timeout_s=10.0,
    )
    return Bench(wire, WireTrigger(wire, rate_hz), replace(plan, **changes))


def make_spec() -> RecordingSpec:
    """A recording of these devices; the recorder sets its first line."""
    camera = {"white_dn": WHITE, "black_level_dn": 0.0, "responsivity_dn": 1.0}
    return RecordingSpec(
        run_id="run-1",
        stages=STAGES,
        substeps=SUBSTEPS,
        pixels=PIXELS,
        dtype="uint16",
        first_line=0,
        clock=ClockFit(CLOCK_HZ, 1_700_000_000_000_000_000, 1000),
        code=CODE.to_attrs(),
        substep_ticks=SUBSTEP_TICKS,
        trigger={},
        cameras={"a": camera, "b": camera},
        config={},
        chunk_lines=512,
    )
