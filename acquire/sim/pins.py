"""The pins of a trigger that runs in its own process, as simulated cameras see them.

The wire of `acquire.sim.clock` states when pulses are due. This page records which pulses have come, and the
light in every sub-step that has ended::

    gateware's process                      memfd                              camera processes
    publish  ──▶ [ sequence | run | pulses a, b | sub-steps | light ... ] ◀── read, wait, light

Reading is optimistic, as with the wire: the sequence is odd while the writer writes, and a reading is valid
only if it was the same even number before and after. Light is kept for ROOM sub-steps, one byte each.
"""

from __future__ import annotations

import mmap
import os
import time
import weakref
from dataclasses import dataclass, field
from fractions import Fraction
from multiprocessing.context import assert_spawning
from multiprocessing.reduction import DupFd
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.clock import NS_PER_S
from acquire.errors import DeviceError
from acquire.lines import ARMS
from acquire.sim.clock import HostClock, PulseTrain, WireReading, attempts

if TYPE_CHECKING:
    from numpy.typing import NDArray

ROOM = 1 << 23
"""Number of sub-steps whose light is kept: more than a minute."""
_HEADER_BYTES = 4096
# indices of 64-bit words; two are pulses and two are delays, one for each arm
_SEQUENCE, _RUN, _RUNNING, _PULSES, _SUBSTEPS = 0, 1, 2, 3, 5
_PERIOD_CLOCKS, _CLOCK_HZ, _DELAYS, _FIELDS = 6, 7, 8, 10
_POLL_S = 0.001
_LIGHT_S = 10.0
"""Longest wait of a camera for light, which it needs some hundred lines ahead."""


@dataclass(frozen=True, slots=True)
class PinRun:
    """What the pins have shown of one run.

    ``number`` counts from 1; ``line_clocks`` is the line period in clock cycles, 0 until it is known.
    """

    number: int
    running: bool
    pulses: tuple[int, int]
    """Rising edges of trigger A and B."""
    line_clocks: int
    delay_clocks: tuple[int, int] = (0, 0)
    """From a line to its pulses A and B."""


class PinPage:
    """The page. One process publishes, any number read; it can be passed to a child being spawned."""

    def __init__(self, descriptor: int | None = None) -> None:
        """Create a page, or map the one behind an inherited descriptor and take over that descriptor."""
        if descriptor is None:
            descriptor = os.memfd_create("acquire-pins", os.MFD_CLOEXEC)
            os.ftruncate(descriptor, _HEADER_BYTES + ROOM)
        self.descriptor = descriptor
        self._page = mmap.mmap(descriptor, _HEADER_BYTES + ROOM)
        self._header = np.frombuffer(self._page, np.uint64, _FIELDS)
        self._light = np.frombuffer(self._page, np.uint8, ROOM, _HEADER_BYTES)
        self._close_descriptor = weakref.finalize(self, os.close, descriptor)

    def close(self) -> None:
        """Unmap the page, which must not be read afterwards. Idempotent.

        A page that is garbage-collected closes itself.
        """
        # A memory map cannot be closed while arrays refer to it.
        self._header, self._light = np.empty(0, np.uint64), np.empty(0, np.uint8)
        self._page.close()
        self._close_descriptor()

    def __reduce__(self) -> tuple[object, ...]:
        assert_spawning(self)
        return _receive, (DupFd(self.descriptor),)

    def publish(self, run: PinRun, light: bytes, clock_hz: int) -> None:
        """Publish the state of a run; ``light`` has one byte per sub-step that ended since the last call."""
        header = self._header
        # Odd until the end: who reads meanwhile tries again.
        header[_SEQUENCE] += np.uint64(1)
        # The light of a new run is written from the beginning of the page again.
        done = 0 if run.number != header[_RUN] else int(header[_SUBSTEPS])
        places = (done + np.arange(len(light))) % ROOM
        self._light[places] = np.frombuffer(light, np.uint8)
        header[_RUN:_FIELDS] = (
            run.number,
            run.running,
            *run.pulses,
            done + len(light),
            run.line_clocks,
            clock_hz,
            *run.delay_clocks,
        )
        header[_SEQUENCE] += np.uint64(1)

    def read(self) -> NDArray[np.uint64]:
        """Return the header's fields, all from one moment."""
        for _ in attempts():
            before = int(self._header[_SEQUENCE])
            fields = self._header.copy()
            if not before & 1 and before == int(self._header[_SEQUENCE]):
                return fields
        raise DeviceError(
            "the gateware's process died while it was publishing its pins",
            hint="arm again, which starts another; python -m firmware.twin shows why it ended",
        )

    @property
    def latest_run(self) -> int:
        """Number of the latest run, 0 before the first."""
        return int(self.read()[_RUN])

    def light(self, run: int, start: int, length: int) -> NDArray[np.uint8]:
        """Return the light (0 or 1) of ``length`` sub-steps once they have ended; dark outside the run.

        Raises DeviceError if the light does not come in time, or is no longer kept.
        """
        fields = self._await_light(run, start + length)
        index = np.arange(start, start + length)
        lit = self._light[index % ROOM] * ((index >= 0) & (index < int(fields[_SUBSTEPS])))
        # What was written over it in the meantime may be of the same run or of the next one.
        now = self.read()
        if now[_RUN] != run:
            raise _over(run)
        if int(now[_SUBSTEPS]) - max(start, 0) > ROOM:
            raise DeviceError(
                f"a camera asked too late for the light of sub-step {start}",
                hint="a host that is less busy, or trigger.driver = 'simulated', which needs less of it",
            )
        return lit.astype(np.uint8)

    def _await_light(self, run: int, end: int) -> NDArray[np.uint64]:
        """Wait until sub-step ``end`` of the run has begun or the run has ended; return the header."""
        deadline_s = time.monotonic() + _LIGHT_S
        while time.monotonic() < deadline_s:
            fields = self.read()
            if fields[_RUN] != run:
                raise _over(run)
            if fields[_SUBSTEPS] >= end or not fields[_RUNNING]:
                return fields
            time.sleep(_POLL_S)
        raise DeviceError(
            f"sub-step {end} of the trigger did not end within {_LIGHT_S:g} s",
            hint="a host that is less busy, or trigger.driver = 'simulated', which needs less of it",
        )


@dataclass(frozen=True, slots=True)
class PinWire:
    """One camera's end of the page, in place of a `Wire`: it reports the pulses of its own arm."""

    page: PinPage
    arm: str
    clock: HostClock = field(default_factory=HostClock)

    def read(self) -> WireReading:
        """Return the run that the pins show, as a pulse train, and this arm's pulses so far."""
        fields = [int(value) for value in self.page.read()]
        issued = fields[_PULSES + ARMS.index(self.arm)]
        if fields[_RUN] == 0:
            return WireReading(None, 0)
        period_ns = Fraction(fields[_PERIOD_CLOCKS] * NS_PER_S, fields[_CLOCK_HZ])
        delay_s = fields[_DELAYS + ARMS.index(self.arm)] / fields[_CLOCK_HZ]
        stopped = None if fields[_RUNNING] else issued
        code = {"kind": "pins", "run": fields[_RUN]}
        return WireReading(
            PulseTrain(
                run=fields[_RUN],
                # The pins show which pulses have come, not when: times count from the run's start.
                start_ns=0,
                line_period_ns=period_ns,
                speed=Fraction(1),
                code=code,
                stopped_after=stopped,
                settled_s={self.arm: delay_s},
            ),
            issued,
        )

    def wait(self, run: int, pulses: int, timeout_s: float) -> WireReading:
        """Wait as `Wire.wait` does."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            reading = self.read()
            done = reading.run == run and (reading.stopped or reading.issued >= pulses)
            if done or reading.run > run or time.monotonic() >= deadline_s:
                return reading
            time.sleep(_POLL_S)

    def code(self, train: PulseTrain) -> PinCode:
        """Return the light that was emitted during a train."""
        return PinCode(self.page, train.run)


@dataclass(frozen=True, slots=True)
class PinCode:
    """The light that was actually emitted, as the code of a run."""

    page: PinPage
    run: int

    def bits(self, start: int, length: int) -> NDArray[np.uint8]:
        return self.page.light(self.run, start, length)

    def to_attrs(self) -> dict[str, Any]:
        return {"kind": "pins", "run": self.run}


def _over(run: int) -> DeviceError:
    return DeviceError(
        f"run {run} of the trigger is over, and its light is no longer kept",
        hint="arm the cameras again, for the present run",
    )


def _receive(duplicate: Any) -> PinPage:
    return PinPage(duplicate.detach())
