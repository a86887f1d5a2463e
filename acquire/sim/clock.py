"""The wire between a simulated trigger and simulated cameras: who pulses, since when, how fast.

Nothing travels along it. The trigger writes down one *pulse train* in a page of shared memory without a
name, and whoever holds the page works out from the host's monotonic clock how many pulses have been
issued by now::

    trigger process                   memfd, one page                      camera processes
    start / stop  ──▶ [ sequence | crc | length | pulse train as JSON ] ◀── look / wait

Pulse ``p`` is issued ``p`` line periods of simulated time after the start; simulated time runs ``speed``
times as fast as the host's. All of it is exact integer arithmetic.

Reading is optimistic (a sequence lock): the sequence is odd while the trigger writes, and a reading counts
only if the sequence was the same even number before and after it *and the clock* were read. So no reader
can believe in a pulse that a stop has cut off. The checksum catches the rest, whatever a processor
reorders. A trigger killed half-way through a write leaves an odd sequence: readers then raise.
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
    from collections.abc import Callable, Mapping

    from acquire.codes import Code

_PAGE = 4096
_SEQUENCE = struct.Struct("@Q")  # native: one 8-byte store
_RECORD = struct.Struct("@II")
_RECORD_AT = _SEQUENCE.size
_PAYLOAD_AT = _RECORD_AT + _RECORD.size
_ROOM = _PAGE - _PAYLOAD_AT - 64
"""Bytes for a train when it starts; the number it stops after comes on top."""
_POLL_S = 0.002
"""How often a waiter looks for a start; pulses themselves are awaited by their due time."""
_STOP_POLL_S = 0.008
"""How often it looks for a stop while pulses come: often would be most of what a fast camera costs."""
_WRITE_S, _LONGEST_WRITE_S = 1e-5, 5e-3
"""Between two looks at a wire that is being written, at first and at last: readers run before the writer on a
busy host, and two that look all the time would keep it from going on."""
_TORN_S = 15.0
"""A write takes microseconds, or as long as a busy host keeps the writer from running: a sequence that
stays odd this long belongs to a writer that died."""


class Clock(Protocol):
    """The host's time. Tests supply one that moves when it is told to."""

    def monotonic_ns(self) -> int: ...

    def utc_ns(self) -> int:
        """ns since 1970-01-01T00:00:00 UTC."""
        ...

    def sleep(self, duration_s: float) -> None: ...


class HostClock:
    """CLOCK_MONOTONIC, which all processes of a host share, and the host's UTC."""

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()

    def utc_ns(self) -> int:
        return time.time_ns()

    def sleep(self, duration_s: float) -> None:
        time.sleep(duration_s)


@dataclass(frozen=True, slots=True)
class PulseTrain:
    """The pulses of one run: pulse ``p`` comes ``p · line_period_ns / speed`` ns after ``start_ns``.

    ``run`` counts the trains of a wire from 1; ``start_ns`` is CLOCK_MONOTONIC; ``line_period_ns`` is
    simulated time; ``code`` is what `acquire.codes.code_from_attrs` reads; ``stopped_after`` is the
    number of pulses after which the train ended, None while it lasts; ``budget`` is the number that it
    does not exceed unless more are allowed, None where only a stop ends it; ``settled_s`` is by how much the
    trigger starts an arm's line after the light of its first sub-step, by its lead and delays; ``lit_part``
    is from where to where of a lit sub-step the light is on.
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
        """Pulses issued by ``now_ns``, pulse 0 at the start included; 0 before the start."""
        spacing = self.line_period_ns / self.speed
        elapsed_ns = now_ns - self.start_ns
        pulses = elapsed_ns * spacing.denominator // spacing.numerator + 1 if elapsed_ns >= 0 else 0
        limits = [limit for limit in (self.stopped_after, self.budget) if limit is not None]
        return min(pulses, *limits) if limits else pulses

    def due_ns(self, pulse: int) -> int:
        """The first whole ns (CLOCK_MONOTONIC) at which ``pulse`` has been issued."""
        spacing = self.line_period_ns / self.speed
        return self.start_ns - (-pulse * spacing.numerator // spacing.denominator)


@dataclass(frozen=True, slots=True)
class Reading:
    """What a look at the wire showed: the latest train, None before the first, and its pulses so far."""

    train: PulseTrain | None
    issued: int

    @property
    def run(self) -> int:
        return 0 if self.train is None else self.train.run

    @property
    def stopped(self) -> bool:
        return self.train is not None and self.train.stopped_after is not None

    @property
    def running(self) -> bool:
        return self.train is not None and self.train.stopped_after is None


class Wire:
    """One trigger's pulses, seen by every process that was given the wire when it was spawned.

    One process writes (the trigger's), any number look. A wire can be given to a child only while that
    child is being spawned; it has no name that could outlive the processes. Closing is idempotent, and a
    forgotten wire closes itself.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        descriptor = os.memfd_create("acquire-wire", os.MFD_CLOEXEC)
        os.ftruncate(descriptor, _PAGE)
        self._attach(descriptor, clock or HostClock())

    def _attach(self, descriptor: int, clock: Clock) -> None:
        self.clock = clock
        self._descriptor = descriptor
        self._page = mmap.mmap(descriptor, _PAGE)
        self._writing = threading.Lock()
        self._known: tuple[int, PulseTrain | None] = (0, None)
        self.close: Callable[[], object] = weakref.finalize(self, _release, self._page, descriptor)

    def __reduce__(self) -> tuple[object, ...]:
        assert_spawning(self)
        return _receive, (DupFd(self._descriptor),)

    def start(
        self,
        line_period_ns: Fraction,
        speed: Fraction,
        code: Mapping[str, Any],
        start_ns: int | None = None,
        budget: int | None = None,
        settled_s: Mapping[str, float] | None = None,
        lit_part: tuple[float, float] = (0.0, 1.0),
    ) -> PulseTrain:
        """Begin a train now, or at ``start_ns``; DeviceError while another one lasts."""
        with self._writing:
            sequence, latest = self._observe()
            if latest.running:
                raise DeviceError(f"pulse train {latest.run} still runs", hint="stop it first")
            train = PulseTrain(latest.run + 1, 0, line_period_ns, speed, dict(code), budget=budget)
            train = replace(train, settled_s=dict(settled_s or {}), lit_part=lit_part)
            if len(_encode(train)) > _ROOM:
                raise UsageError(
                    f"a code of {len(_encode(train))} bytes is too long", possible=f"{_ROOM} on the wire"
                )
            return self._write(
                sequence, lambda now_ns: replace(train, start_ns=now_ns if start_ns is None else start_ns)
            )

    def stop(self) -> int:
        """End the train after the pulses issued so far; their number. Idempotent."""
        with self._writing:
            sequence, latest = self._observe()
            train = latest.train
            if train is None or train.stopped_after is not None:
                return latest.issued
            ended = self._write(sequence, lambda now_ns: replace(train, stopped_after=train.issued(now_ns)))
            return ended.stopped_after or 0

    def allow(self, pulses: int) -> int:
        """Let the train issue ``pulses`` pulses and no more, unless more are allowed later.

        Returns the number it will issue: at least one, and those issued so far.
        """
        with self._writing:
            sequence, latest = self._observe()
            train = latest.train
            if train is None or train.stopped_after is not None:
                return latest.issued
            allowed = self._write(
                sequence, lambda now_ns: replace(train, budget=max(1, pulses, train.issued(now_ns)))
            )
            return allowed.budget or 0

    def read(self) -> Reading:
        """The latest train and the pulses it has issued at this moment."""
        return self._observe()[1]

    def code(self, train: PulseTrain) -> Code:
        """The light's code during a train."""
        return code_from_attrs(train.code)

    def wait(self, run: int, pulses: int, timeout_s: float) -> Reading:
        """Look until train ``run`` has issued ``pulses`` pulses or has ended, at most for ``timeout_s``.

        The last reading is returned whatever it shows. A later train than ``run`` also ends the wait.
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
                wake_ns, nap_s = min(wake_ns, reading.train.due_ns(pulses - 1)), _STOP_POLL_S
            self.clock.sleep(min(nap_s, max(wake_ns - now_ns, 1) * 1e-9))

    def _observe(self) -> tuple[int, Reading]:
        """A sequence and the reading that belongs to it."""
        patience_ns, nap_s = time.monotonic_ns() + int(_TORN_S * 1e9), _WRITE_S
        while time.monotonic_ns() < patience_ns:
            sequence = self._sequence()
            # A lock that readers never take: odd while a train is being written, and what was read counts
            # only if the number is the same afterwards. The time is read in between, or a train might issue
            # pulses that its stop had forbidden.
            if not sequence & 1 and self._refresh(sequence):
                train, now_ns = self._known[1], self.clock.monotonic_ns()
                if self._sequence() == sequence == self._known[0]:
                    return sequence, Reading(train, 0 if train is None else train.issued(now_ns))
            time.sleep(nap_s)
            nap_s = min(2 * nap_s, _LONGEST_WRITE_S)
        raise DeviceError("the simulated trigger died while it wrote on the wire")

    def _sequence(self) -> int:
        number: int = _SEQUENCE.unpack_from(self._page, 0)[0]
        return number

    def _refresh(self, sequence: int) -> bool:
        """Make the train of an even ``sequence`` known; False if its bytes do not belong together."""
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
        """Put a train on the wire; ``train_at`` is given the time once no reader trusts the old one."""
        _SEQUENCE.pack_into(self._page, 0, sequence + 1)
        train = train_at(self.clock.monotonic_ns())
        payload = _encode(train)
        _RECORD.pack_into(self._page, _RECORD_AT, zlib.crc32(payload), len(payload))
        self._page[_PAYLOAD_AT : _PAYLOAD_AT + len(payload)] = payload
        _SEQUENCE.pack_into(self._page, 0, sequence + 2)
        return train


def _encode(train: PulseTrain) -> bytes:
    timing = (train.run, train.start_ns, str(train.line_period_ns), str(train.speed), dict(train.code))
    limits = (train.stopped_after, train.budget)
    return json.dumps([*timing, *limits, dict(train.settled_s), train.lit_part]).encode()


def _receive(duplicate: Any) -> Wire:
    wire = Wire.__new__(Wire)
    wire._attach(duplicate.detach(), HostClock())
    return wire


def _release(page: mmap.mmap, descriptor: int) -> None:
    page.close()
    os.close(descriptor)
