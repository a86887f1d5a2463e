"""The behavioural model of the trigger's device: the same bytes, registers and refusals as the gateware.

::

    bytes ──▶ feed ──▶ [ registers · run ] ──▶ take ──▶ bytes: answers, then the tags that are due
                              │
                              └──▶ Wire ──▶ simulated cameras

Nothing runs between calls: lines, tags and the end of a run are computed from the time of the call, in exact
integers. Simulated time runs ``speed`` times as fast as the host's during a run, and at the host's speed
otherwise. A run's code must fit into the wire's page, so cameras follow pseudo-random and constant codes; for
a code from the code memory the wire carries the pulses of a dark run.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from fractions import Fraction
from typing import TYPE_CHECKING

from acquire.clock import NS_PER_S
from acquire.sim.arming import Refusal, check_configuration
from acquire.sim.trigger_code import light_attrs, prbs_state
from acquire.sim.trigger_registers import (
    BARK_CLOCKS,
    RUN_CLOCKS,
    START_LATENCY,
    TAG_ROOM,
    RegisterBank,
    constants,
)
from acquire.sim.trigger_run import ArmedRun
from acquire.trigger import registers as r
from acquire.trigger.frames import (
    Decoder,
    Frame,
    FrameLengthError,
    encode,
    nak_payload,
    parse_read,
    parse_write,
    write_payload,
)
from acquire.trigger.registers import Command, EndReason, ErrorCode, FrameType, State, TagFlag, TagRecord

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.sim.clock import Wire

_WORD = 0xFFFFFFFF
_ENDS = {
    EndReason.LINE_BUDGET: TagFlag.BUDGET,
    EndReason.WATCHDOG: TagFlag.WATCHDOG,
    EndReason.CLOCK_LOST: TagFlag.CLOCK_LOST,
}


class TriggerModel:
    """One trigger. Thread-safe; never waits.

    Parameters
    ----------
    wire : carries the pulses to the simulated cameras, and supplies the clock
    clock_hz : frequency of the trigger's clock
    speed : simulated seconds per second during a run
    """

    def __init__(self, wire: Wire, clock_hz: int, speed: float = 1.0, serial: int = 0) -> None:
        self._wire = wire
        self._clock_hz = clock_hz
        # By its decimal digits: 0.1 is a tenth, not the binary fraction next to it.
        self._speed = Fraction(str(speed))
        self._lock = threading.RLock()
        self._decoder = Decoder()
        self._out: deque[bytes] = deque()
        self._tags: deque[bytes] = deque()
        self._run = ArmedRun()
        self._zero = (wire.clock.monotonic_ns(), 0, Fraction(1))
        self._pps: tuple[int, int] = (0, 0)
        self._clock_losses = 0
        self._locked = True
        status: dict[r.Register, Callable[[], int]] = {
            r.STATUS: self._status,
            r.CURRENT_RUN: lambda: self._run.number,
            r.TIME: lambda: self._tick() & (1 << r.TIME_BITS) - 1,
            r.START_TIME: lambda: self._run.start_tick if self._run.lines else 0,
            r.LINES: lambda: self._run.lines,
            r.CODE_STATE: self._code_state,
            # Counters of 32 bits start at 0 again, as in the gateware.
            r.TAG_COUNT: lambda: self._run.made & _WORD,
            r.TAG_LOST: lambda: self._run.lost & _WORD,
            r.TAG_FIFO: lambda: r.TAG_FIFO.pack(fill=len(self._tags), peak=self._run.peak),
            r.RX_ERRORS: lambda: self._decoder.faults.total() & _WORD,
            r.PPS_TIME: lambda: self._pps[0],
            r.PPS_COUNT: lambda: self._pps[1],
        }
        self.registers = RegisterBank(constants(clock_hz, serial), status, self._command, self._demand_idle)

    # The link.

    @property
    def busy(self) -> bool:
        """Always False: its time is the host's, and passes without further calls."""
        return False

    def feed(self, data: bytes) -> None:
        """Take bytes from the host."""
        with self._lock:
            for frame in self._decoder.feed(data):
                self._advance()  # everything that was due before the request happens before it
                try:
                    kind, payload = self._execute(frame)
                except FrameLengthError:
                    kind, payload = FrameType.NAK, nak_payload(ErrorCode.BAD_LENGTH, 0)
                except Refusal as refusal:
                    kind, payload = FrameType.NAK, nak_payload(refusal.code, refusal.address)
                self._out.append(encode(Frame(kind, frame.sequence, payload)))

    def take(self) -> bytes:
        """Return all bytes that are due for the host."""
        with self._lock:
            self._advance()
            data = b"".join((*self._out, *self._tags))
            self._out.clear()
            self._tags.clear()
            return data

    @property
    def frames_heard(self) -> int:
        """Number of requests received so far."""
        return self._decoder.frames

    # The inputs.

    def external_edge(self) -> None:
        """Simulate the external arm input going to its active level."""
        with self._lock:
            self._advance()
            if self.registers.field(r.EXTERNAL_ARM, "enable") and self._run.state == State.ARMED:
                self._begin(external=True)

    def pps_edge(self) -> None:
        """Simulate the beginning of a second of the reference."""
        with self._lock:
            self._advance()
            self._pps = (self._tick(), self._pps[1] + 1)
            if self._run.state in (State.RUNNING, State.STOPPING):
                self._queue_tag(self._record(self._run.lines, self._tick(), TagFlag.PPS))

    def lose_clock(self, lost: bool = True) -> None:
        """Simulate the loss of the reference clock, which ends a run, or its return."""
        with self._lock:
            self._advance()
            self._locked = not lost
            self._clock_losses += lost
            if lost:
                self._end(EndReason.CLOCK_LOST)

    # Requests.

    def _execute(self, frame: Frame) -> tuple[FrameType, bytes]:
        if frame.version != r.PROTOCOL_VERSION:
            raise Refusal(ErrorCode.BAD_VERSION, 0)
        if frame.type == FrameType.READ:
            address, count = parse_read(frame.payload)
            self._feed_watchdog(self._tick())
            return FrameType.DATA, write_payload(address, self.registers.read(address, count))
        if frame.type == FrameType.WRITE:
            address, words = parse_write(frame.payload)
            # Before the words, since a refused one also shows that the host lives.
            self._feed_watchdog(self._tick())
            for i, word in enumerate(words):
                self.registers.write(address + i, word)
            return FrameType.ACK, frame.payload[:2] + bytes([len(words)])
        raise Refusal(ErrorCode.BAD_TYPE, 0)

    def _command(self, word: int) -> None:
        number, at = self.registers.get(r.RUN_ID), r.COMMAND.address
        match word:
            case Command.ARM:
                self._arm(number)
            case Command.START:
                if self._run.state == State.IDLE:
                    raise Refusal(ErrorCode.NOT_ARMED, at)
                if number != self._run.number:
                    raise Refusal(ErrorCode.WRONG_RUN, at)
                if self._run.state == State.ARMED:
                    self._begin(external=False)
            case Command.STOP:
                if number not in (0, self._run.number):
                    raise Refusal(ErrorCode.WRONG_RUN, at)
                self._end(EndReason.STOPPED)
            case Command.CHECK_CODE:
                self._demand_idle(at)
                self.registers.check_code()
            case Command.SELF_TEST:
                self._demand_idle(at)
                self.registers.clear_code()
                self.registers.put(r.SELF_TEST, r.SELF_TEST.pack(done=1))
            case _:
                raise Refusal(ErrorCode.BAD_COMMAND, at)

    def _arm(self, number: int) -> None:
        run, at = self._run, r.COMMAND.address
        if number == 0:
            raise Refusal(ErrorCode.BAD_RUN_ID, at)
        if number == run.number and run.state != State.IDLE:
            if run.state == State.ENDED:
                raise Refusal(ErrorCode.RUN_OVER, at)
            return  # a repeated command: the host did not receive the answer to the first
        self._demand_idle(at)
        try:
            check_configuration(self.registers.get, self._locked, self.registers.code_checked)
        except Refusal as refusal:
            self.registers.put(r.REJECT, r.REJECT.pack(error=refusal.code, address=refusal.address))
            raise
        self.registers.put(r.REJECT, 0)
        self._tags.clear()
        line_clocks = self.registers.field(r.LINE, "substeps") * self.registers.get(r.SUBSTEP_CLOCKS)
        budget = self.registers.get(r.LINE_BUDGET) or None
        self._run = ArmedRun(number, State.ARMED, line_clocks=line_clocks, budget=budget)

    def _demand_idle(self, address: int) -> None:
        """Raise Refusal while a run is armed or running."""
        if self._run.state not in (State.IDLE, State.ENDED):
            raise Refusal(ErrorCode.BUSY, address)

    # The run in time.

    def _begin(self, external: bool) -> None:
        run, clock = self._run, self._wire.clock
        now_ns, now_tick = clock.monotonic_ns(), self._tick()
        latency = START_LATENCY + self._lead()
        run.start_tick, run.state, run.external = now_tick + latency, State.RUNNING, external
        rate = self._clock_hz * self._speed / NS_PER_S
        # Rounded up: not before its tick.
        start_ns = now_ns + -(-latency * rate.denominator // rate.numerator)
        self._zero = (start_ns, run.start_tick, self._speed)
        # The watchdog is active from the run's first clock, whoever started the run.
        self._feed_watchdog(run.start_tick - self._lead() - RUN_CLOCKS)
        period_ns = Fraction(run.line_clocks * NS_PER_S, self._clock_hz)
        attrs = light_attrs(self.registers.get)
        # arm → delay of its line's start after the light of the line's first sub-step
        delays = {"a": r.TRIGGER_A_DELAY, "b": r.TRIGGER_B_DELAY}
        settled_s = {
            arm: (self._lead() + self.registers.get(delay)) / self._clock_hz for arm, delay in delays.items()
        }
        begin, end = self.registers.get(r.WINDOW_OPEN), self.registers.get(r.WINDOW_CLOSE)
        clocks = self.registers.get(r.SUBSTEP_CLOCKS)
        lit_part = begin / clocks, end / clocks
        self._wire.start(
            line_period_ns=period_ns,
            speed=self._speed,
            code=attrs,
            start_ns=start_ns,
            budget=self._lines_allowed(),
            settled_s=settled_s,
            lit_part=lit_part,
        )

    def _feed_watchdog(self, tick: int) -> None:
        """Restart the watchdog's period at ``tick``, when the host was last heard.

        The period is in the host's time: simulated time that runs faster does not shorten it.
        """
        run, period = self._run, self.registers.get(r.WATCHDOG)
        if run.state != State.RUNNING or not period:
            return
        run.bark_tick = tick + math.ceil(period * self._speed) + BARK_CLOCKS
        # A host that falls silent makes no further call: the wire must know now where the pulses end.
        if self._wire.read().running:
            self._wire.allow(self._lines_allowed() or 0)

    def _lines_allowed(self) -> int | None:
        """Return the lines of the run if the host stays silent from now on; None if it then never ends."""
        run = self._run
        if run.bark_tick is None:
            return run.budget
        decided = self._lead() + 1  # clocks before a line at which it is decided whether it comes
        silent = max(1, -(-(run.bark_tick + decided - run.start_tick) // run.line_clocks))
        return silent if run.budget is None else min(silent, run.budget)

    def _lead(self) -> int:
        return self.registers.field(r.LED, "lead")

    def _advance(self) -> None:
        """Carry out everything that is due by now."""
        run = self._run
        if run.state not in (State.RUNNING, State.STOPPING):
            return
        tick = self._tick()  # taken before reading the wire, which has then issued all lines up to it
        lines = self._wire.read().issued
        self._queue_line_tags(run.lines, lines)
        run.lines = lines
        # The budget's last line or the watchdog begins the stop, whichever comes first.
        ends = [(run.bark_tick, EndReason.WATCHDOG)] if run.bark_tick is not None else []
        if run.budget is not None:
            ends.append((run.start_tick + (run.budget - 1) * run.line_clocks, EndReason.LINE_BUDGET))
        if run.state == State.RUNNING and ends:
            first_tick, reason = min(ends, key=lambda end: end[0])
            if tick >= first_tick:
                run.state, run.reason, run.limit = State.STOPPING, reason, self._lines_allowed()
        if run.limit is not None and tick >= (end := run.start_tick + run.limit * run.line_clocks):
            self._finish(run.reason, end)

    def _end(self, reason: EndReason) -> None:
        """End the run: at once before line 0, else after the current line, which cameras may have seen."""
        run = self._run
        if run.state == State.ARMED:
            run.limit = 0
            self._finish(reason, self._tick())
        elif run.state == State.RUNNING:
            run.state, run.reason = State.STOPPING, reason
            run.limit = self._wire.allow(0)

    def _finish(self, reason: EndReason, tick: int) -> None:
        run = self._run
        if run.state != State.ARMED:
            self._wire.stop()
        run.state, run.reason = State.ENDED, reason
        flags = TagFlag.LAST | _ENDS.get(reason, TagFlag(0))
        self._queue_tag(self._record(run.lines, tick, flags if run.lines else flags | TagFlag.NO_LINES))
        now_ns = self._wire.clock.monotonic_ns()
        # From here on at the host's speed, but without a jump: the trigger's time only grows.
        self._zero = (now_ns, self._tick_at(now_ns), Fraction(1))

    def _queue_line_tags(self, first: int, end: int) -> None:
        """Queue the tags of lines ``first`` to ``end - 1``, at every interval."""
        run, every = self._run, self.registers.get(r.TAG_INTERVAL)
        due = range(-(-first // every) * every, end, every)
        for number, line in enumerate(due):
            # No tag is taken in the meantime, so the rest are lost, too: a late host need not wait for them.
            if len(self._tags) >= TAG_ROOM:
                self._lose_tags(len(due) - number)
                return
            flags = TagFlag.LINE
            if line == 0:
                flags |= TagFlag.FIRST | (TagFlag.EXTERNAL if run.external else TagFlag(0))
            self._queue_tag(self._record(line + 1, run.start_tick + line * run.line_clocks, flags))

    def _record(self, lines: int, tick: int, flags: int) -> TagRecord:
        run, line = self._run, max(0, lines - 1)
        substeps = self.registers.field(r.LINE, "substeps")
        time = tick & (1 << r.TIME_BITS) - 1
        return TagRecord(run.number & _WORD, line, line * substeps, time, int(flags))

    def _queue_tag(self, record: TagRecord) -> None:
        """Queue a tag for the host, or lose it if the queue is full."""
        run = self._run
        if len(self._tags) >= TAG_ROOM:
            self._lose_tags(1)
            return
        number, run.made = run.made, run.made + 1
        if run.gap:
            record, run.gap = record._replace(flags=record.flags | TagFlag.TAGS_LOST), False
        self._tags.append(encode(Frame(FrameType.TAG, number & 0xFFFF, r.pack_tag(record))))
        run.peak = max(run.peak, len(self._tags))

    def _lose_tags(self, count: int) -> None:
        """Account for ``count`` tags that find no room."""
        run = self._run
        run.made, run.lost, run.gap = run.made + count, run.lost + count, True

    def _tick(self) -> int:
        return self._tick_at(self._wire.clock.monotonic_ns())

    def _tick_at(self, now_ns: int) -> int:
        zero_ns, zero_tick, speed = self._zero
        rate = self._clock_hz * speed
        return zero_tick + (now_ns - zero_ns) * rate.numerator // (NS_PER_S * rate.denominator)

    def _status(self) -> int:
        return r.STATUS.pack(
            state=self._run.state,
            code_checked=self.registers.code_checked,
            clock_locked=self._locked,
            pps_seen=self._pps[1] > 0,
            end_reason=self._run.reason if self._run.state == State.ENDED else EndReason.NONE,
            clock_losses=self._clock_losses & 0xFFFF,
        )

    def _code_state(self) -> int:
        if self._run.state != State.ENDED or self.registers.field(r.CODE_SOURCE, "kind") != r.Source.PRBS:
            return 0
        index = self.registers.field(r.LINE, "substeps") * max(0, self._run.lines - 1)
        return prbs_state(self.registers.get(r.PRBS_MASK), self.registers.get(r.PRBS_SEED), index)
