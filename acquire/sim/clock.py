"""The wire between a simulated trigger and simulated cameras: a pulse train with its start and its rate.

Nothing travels along it. The trigger writes one *pulse train* into an anonymous page of shared memory, and
every process that maps the page computes from the host's monotonic clock how many pulses have been issued
so far::

    trigger process                   memfd, one page                      camera processes
    start / stop  ──▶ [ sequence | crc | length | pulse train as JSON ] ◀── read / wait

Pulse ``p`` is issued ``p`` line periods of simulated time after the start; simulated time runs ``speed``
times as fast as the host's. All arithmetic is exact, on integers.

Reading is optimistic (a sequence lock): the sequence is odd while the trigger writes, and a reading is valid
only if the sequence was the same even number before and after both the train *and the clock* were read. So
no reader can count a pulse that a stop has cut off. The checksum catches anything that the processor
reorders. A trigger killed half-way through a write leaves an odd sequence, and readers then raise.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import threading
import time
import weakref
import zlib
from dataclasses import dataclass, field, replace
from fractions import Fraction
from multiprocessing.context import assert_spawning
from multiprocessing.reduction import DupFd
from typing import TYPE_CHECKING, Any, Protocol

from acquire.codes import code_from_attrs
from acquire.errors import DeviceError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from acquire.codes import Code

# The least that can be mapped.
_PAGE = 4096
_SEQUENCE = struct.Struct("@Q")  # native: one 8-byte store
_RECORD = struct.Struct("@II")
_RECORD_AT = _SEQUENCE.size
_PAYLOAD_AT = _RECORD_AT + _RECORD.size
_ROOM = _PAGE - _PAYLOAD_AT - 64
"""Bytes available for a train when it starts; 64 more are reserved for its start, a later budget and the
count it stops after."""
_POLL_S = 0.002
"""Polling interval while waiting for a start; pulses themselves are awaited by their due time."""
_STOP_POLL_S = 0.008
"""Polling interval for a stop during a train: shorter polling would dominate the cost of a fast camera."""
_WRITE_S, _LONGEST_WRITE_S = 1e-5, 5e-3
"""First and longest pause between two attempts to read while the wire is being written. On a busy host
readers can be scheduled ahead of the writer, and two that poll without pause would keep it from finishing."""
_TORN_S = 15.0
"""A write takes microseconds, or as long as a busy host keeps the writer from running. A sequence that
stays odd this long belongs to a writer that died."""


class Clock(Protocol):
    """The host's time. Tests supply a clock that they advance themselves."""

    def monotonic_ns(self) -> int:
        """Return ns of CLOCK_MONOTONIC, or of the time that a test advances."""
        ...

    def utc_ns(self) -> int:
        """ns since 1970-01-01T00:00:00 UTC."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Wait; a test's clock advances instead."""


class HostClock:
    """CLOCK_MONOTONIC, which all processes of a host share, and the host's UTC."""

    def monotonic_ns(self) -> int:
        """Return ns of CLOCK_MONOTONIC, from which processes compute the same pulses."""
        return time.monotonic_ns()

    def utc_ns(self) -> int:
        """Return ns since 1970 by the host's clock, which may be set meanwhile."""
        return time.time_ns()

    def sleep(self, duration_s: float) -> None:
        """Wait for ``duration_s`` seconds of this host."""
        time.sleep(duration_s)


@dataclass(frozen=True, slots=True)
class PulseTrain:
    """The pulses of one run: pulse ``p`` comes ``p · line_period_ns / speed`` ns after ``start_ns``.

    Attributes
    ----------
    run : number of the train on this wire, counted from 1
    start_ns : CLOCK_MONOTONIC of pulse 0
    line_period_ns : in simulated time
    speed : simulated seconds per second
    code : the light's code, as `acquire.codes.code_from_attrs` reads it
    stopped_after : number of pulses after which the train ended, None while it lasts
    budget : number of pulses that the train does not exceed unless more are allowed; None if only a stop
        ends it
    settled_s : arm → time from the light of a line's first sub-step to the start of the line, which the
        trigger sets by its lead and delays
    lit_part : begin and end of the light within a lit sub-step, as fractions of it
    """

    run: int
    start_ns: int
    line_period_ns: Fraction
    speed: Fraction
    code: Mapping[str, Any]
    stopped_after: int | None = None
    budget: int | None = None
    settled_s: Mapping[str, float] = field(default_factory=dict)
    lit_part: tuple[float, float] = (0.0, 1.0)

    def issued(self, now_ns: int) -> int:
        """Return the pulses issued by ``now_ns``, including pulse 0 at the start; 0 before the start."""
        spacing = self.line_period_ns / self.speed
        elapsed_ns = now_ns - self.start_ns
        # In whole numbers: a float would count a pulse too early or too late after some hours.
        pulses = elapsed_ns * spacing.denominator // spacing.numerator + 1 if elapsed_ns >= 0 else 0
        limits = [limit for limit in (self.stopped_after, self.budget) if limit is not None]
        return min(pulses, *limits) if limits else pulses

    def due_ns(self, pulse: int) -> int:
        """Return the first whole ns (CLOCK_MONOTONIC) at which ``pulse`` has been issued."""
        spacing = self.line_period_ns / self.speed
        return self.start_ns - (-pulse * spacing.numerator // spacing.denominator)  # rounded up


@dataclass(frozen=True, slots=True)
class WireReading:
    """One reading of the wire: the latest train (None before the first) and its pulses so far."""

    train: PulseTrain | None
    issued: int

    @property
    def run(self) -> int:
        return 0 if self.train is None else self.train.run

    @property
    def stopped(self) -> bool:
        """Whether the latest train has ended."""
        return self.train is not None and self.train.stopped_after is not None

    @property
    def running(self) -> bool:
        """Whether there is a train that has not ended."""
        return self.train is not None and self.train.stopped_after is None


def attempts() -> Iterator[None]:
    """Yield for every attempt to read what another process writes, until its writer must have died."""
    # The host's own time: a clock that a test advances stands still while this waits.
    deadline_ns, nap_s = time.monotonic_ns() + int(_TORN_S * 1e9), _WRITE_S
    while time.monotonic_ns() < deadline_ns:
        yield
        time.sleep(nap_s)
        nap_s = min(2 * nap_s, _LONGEST_WRITE_S)


class Wire:
    """One trigger's pulses, visible to every process that was given the wire when it was spawned.

    One process writes (the trigger's); any number read. A wire can be passed to a child only while that
    child is being spawned, because it has no name that could outlive the processes. Closing is idempotent,
    and a wire that is garbage-collected closes itself.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        # Only a child that is given the wire gets the descriptor, and not every program that is started.
        descriptor = os.memfd_create("acquire-wire", os.MFD_CLOEXEC)
        os.ftruncate(descriptor, _PAGE)
        self._attach(descriptor, clock or HostClock())

    def _attach(self, descriptor: int, clock: Clock) -> None:
        self.clock = clock
        self._descriptor = descriptor
        self._page = mmap.mmap(descriptor, _PAGE)
        # A change reads the train and writes it back: two threads must not do so at the same time.
        self._writing = threading.Lock()
        self._known: tuple[int, PulseTrain | None] = (0, None)
        # Without a reference to `self`, so that a wire that nobody holds is collected.
        self.close: Callable[[], object] = weakref.finalize(self, _release, self._page, descriptor)

    def __reduce__(self) -> tuple[object, ...]:
        assert_spawning(self)
        return _receive, (DupFd(self._descriptor),)

    def start(
        self,
        line_period_ns: Fraction,
        speed: Fraction,
        code: Mapping[str, Any],
        *,
        start_ns: int | None = None,
        budget: int | None = None,
        settled_s: Mapping[str, float] | None = None,
        lit_part: tuple[float, float] = (0.0, 1.0),
    ) -> PulseTrain:
        """Begin a train now, or at ``start_ns``. Raises DeviceError while another train lasts."""
        with self._writing:
            sequence, latest = self._observe()
            if latest.running:
                raise DeviceError(f"pulse train {latest.run} is still running", hint="stop it first")
            train = PulseTrain(latest.run + 1, 0, line_period_ns, speed, dict(code), budget=budget)
            train = replace(train, settled_s=dict(settled_s or {}), lit_part=lit_part)
            if len(_encode(train)) > _ROOM:
                raise UsageError(
                    f"a code of {len(_encode(train))} bytes is too long for the wire",
                    possible=f"up to {_ROOM} bytes",
                )
            return self._write(
                sequence, lambda now_ns: replace(train, start_ns=now_ns if start_ns is None else start_ns)
            )

    def stop(self) -> int:
        """End the train after the pulses issued so far and return their number. Idempotent."""
        with self._writing:
            sequence, latest = self._observe()
            train = latest.train
            if train is None or train.stopped_after is not None:
                return latest.issued
            ended = self._write(sequence, lambda now_ns: replace(train, stopped_after=train.issued(now_ns)))
            return ended.stopped_after or 0

    def allow(self, pulses: int) -> int:
        """Let the train issue ``pulses`` pulses and no more, unless more are allowed later.

        Returns the number it will issue: at least one, and no fewer than were issued so far.
        """
        with self._writing:
            sequence, latest = self._observe()
            train = latest.train
            if train is None or train.stopped_after is not None:
                return latest.issued
            # At least one: a run that has started has line 0, whenever it is told to end.
            allowed = self._write(
                sequence, lambda now_ns: replace(train, budget=max(1, pulses, train.issued(now_ns)))
            )
            return allowed.budget or 0

    def read(self) -> WireReading:
        """Return the latest train and the pulses it has issued at this moment."""
        return self._observe()[1]

    def code(self, train: PulseTrain) -> Code:
        """Return the light's code during a train."""
        return code_from_attrs(train.code)

    def wait(self, run: int, pulses: int, timeout_s: float) -> WireReading:
        """Wait until train ``run`` has issued ``pulses`` pulses or has ended, for ``timeout_s`` at most.

        Returns the last reading, whatever it shows. A train later than ``run`` also ends the wait.
        """
        deadline_ns = self.clock.monotonic_ns() + int(timeout_s * 1e9)
        while True:
            reading = self.read()
            if reading.run > run or (reading.run == run and (reading.stopped or reading.issued >= pulses)):
                return reading
            now_ns = self.clock.monotonic_ns()
            if now_ns >= deadline_ns:
                return reading
            wake_ns, nap_s = deadline_ns, _POLL_S
            if reading.train is not None and reading.running and reading.run == run:
                # pulses count from 0: this is the last that is waited for
                wake_ns, nap_s = min(wake_ns, reading.train.due_ns(pulses - 1)), _STOP_POLL_S
            self.clock.sleep(min(nap_s, max(wake_ns - now_ns, 1) * 1e-9))

    def _observe(self) -> tuple[int, WireReading]:
        """Return a sequence number and the reading that belongs to it."""
        for _ in attempts():
            sequence = self._sequence()
            # Readers take no lock: the sequence is odd while a train is being written, and a reading is valid
            # only if the sequence is the same afterwards. The clock is read in between; otherwise a reader
            # could count pulses issued after the stop.
            if not sequence & 1 and self._refresh(sequence):
                train, now_ns = self._known[1], self.clock.monotonic_ns()
                if self._sequence() == sequence == self._known[0]:
                    return sequence, WireReading(train, 0 if train is None else train.issued(now_ns))
        raise DeviceError(
            "the simulated trigger died while it was writing to the wire",
            hint="arm again, which starts another",
        )

    def _sequence(self) -> int:
        number: int = _SEQUENCE.unpack_from(self._page, 0)[0]
        return number

    def _refresh(self, sequence: int) -> bool:
        """Decode and keep the train of an even ``sequence``; return False if its checksum fails."""
        if self._known[0] != sequence:
            checksum, length = _RECORD.unpack_from(self._page, _RECORD_AT)
            payload = self._page[_PAYLOAD_AT : _PAYLOAD_AT + length]
            if zlib.crc32(payload) != checksum:
                return False
            run, start_ns, line_period_ns, speed, code, stopped, budget, settled_s, lit = json.loads(payload)
            timing = run, start_ns, Fraction(line_period_ns), Fraction(speed), code
            train = PulseTrain(*timing, stopped, budget, settled_s, (lit[0], lit[1]))
            self._known = (sequence, train)
        return True

    def _write(self, sequence: int, train_at: Callable[[int], PulseTrain]) -> PulseTrain:
        """Write a train. ``train_at`` receives the time, read once readers no longer accept the old train."""
        _SEQUENCE.pack_into(self._page, 0, sequence + 1)
        train = train_at(self.clock.monotonic_ns())
        payload = _encode(train)
        _RECORD.pack_into(self._page, _RECORD_AT, zlib.crc32(payload), len(payload))
        self._page[_PAYLOAD_AT : _PAYLOAD_AT + len(payload)] = payload
        _SEQUENCE.pack_into(self._page, 0, sequence + 2)
        return train


def _encode(train: PulseTrain) -> bytes:
    # fractions as text: as JSON's floats, pulses would not be exact
    timing = (train.run, train.start_ns, str(train.line_period_ns), str(train.speed), dict(train.code))
    limits = (train.stopped_after, train.budget)
    return json.dumps([*timing, *limits, dict(train.settled_s), train.lit_part]).encode()


def _receive(duplicate: Any) -> Wire:
    # not `Wire()`, which would make a page of its own
    wire = Wire.__new__(Wire)
    wire._attach(duplicate.detach(), HostClock())
    return wire


def _release(page: mmap.mmap, descriptor: int) -> None:
    page.close()
    os.close(descriptor)
