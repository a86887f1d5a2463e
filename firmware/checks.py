r"""Checks at arming: every error condition is kept in a register, and the first one that holds is reported.

::

    configuration  ==X new =====================
    intermediate   ======X distance of pulses ==      two registers behind the configuration, which is
    error          ==========X ErrorCode or 0 ==      constant for far longer before an ARM can come
"""

from amaranth.hdl import Elaboratable, Module, Signal, Value
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

from acquire.trigger import registers as r
from acquire.trigger.registers import ErrorCode, LineMode, Source
from firmware.phases import SUBPHASES
from firmware.registerfile import RegisterFile
from firmware.timing import SUBSTEP_CLOCKS_MIN

Condition = tuple[ErrorCode, r.Register, Value]


class Checks(wiring.Component):
    code_checked: In(1)
    clock_locked: In(1)
    length_good: Out(1)
    """CODE_LENGTH fits the memory."""
    error: Out(16)
    address: Out(16)

    def __init__(self, file: RegisterFile, code_bits: int) -> None:
        self._file, self._code_bits = file, code_bits
        super().__init__()

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        m.d.sync += [self.error.eq(0), self.address.eq(0)]
        # Reversed, since the last assignment counts: the first of several errors in the list is reported.
        for code, register, condition in reversed(self._conditions(m)):
            failed = Signal(name=f"{code.name}_{register.name}".lower())
            m.d.sync += failed.eq(condition)
            with m.If(failed):
                m.d.sync += [self.error.eq(code), self.address.eq(register.address)]
        return m

    def _conditions(self, m: Module) -> list[Condition]:
        value, field = self._file.value, self._file.field
        clocks, substeps = value(r.SUBSTEP_CLOCKS), field(r.LINE, "substeps")
        kind = field(r.CODE_SOURCE, "kind")
        prbs, memory = kind == Source.PRBS, kind == Source.MEMORY
        length = value(r.CODE_LENGTH)
        m.d.sync += self.length_good.eq((length != 0) & (length <= self._code_bits))
        opened, closed = value(r.WINDOW_OPEN), value(r.WINDOW_CLOSE)
        distance = self._distance(m, clocks, substeps)
        return [
            (ErrorCode.CLOCK_UNLOCKED, r.STATUS, ~self.clock_locked),
            (ErrorCode.BAD_SUBSTEP, r.SUBSTEP_CLOCKS, clocks < SUBSTEP_CLOCKS_MIN),
            (ErrorCode.BAD_SUBSTEPS, r.LINE, ~substeps.matches(*SUBPHASES)),
            (ErrorCode.BAD_PHASES, r.PHASE_CLOCKS, self._phases(m, substeps) > clocks),
            (ErrorCode.BAD_TAG_INTERVAL, r.TAG_INTERVAL, value(r.TAG_INTERVAL) == 0),
            (ErrorCode.BAD_SOURCE, r.CODE_SOURCE, ~kind.matches(*map(int, Source))),
            (ErrorCode.BAD_SEED, r.PRBS_MASK, prbs & (value(r.PRBS_MASK) == 0)),
            (ErrorCode.BAD_SEED, r.PRBS_SEED, prbs & (value(r.PRBS_SEED) == 0)),
            (ErrorCode.BAD_CODE_LENGTH, r.CODE_LENGTH, memory & ~self.length_good),
            (ErrorCode.CODE_UNCHECKED, r.CODE_LENGTH, memory & ~self.code_checked),
            (ErrorCode.BAD_WINDOW, r.WINDOW_CLOSE, (opened >= closed) | (closed > clocks)),
            (ErrorCode.BAD_LEAD, r.LED, field(r.LED, "lead") >= clocks),
            *self._pulse(m, ErrorCode.BAD_TRIGGER_A, r.TRIGGER_A, distance),
            *self._pulse(m, ErrorCode.BAD_TRIGGER_B, r.TRIGGER_B, distance),
            (ErrorCode.BAD_MIN_PERIOD, r.CAMERA_MIN_PERIOD, distance < value(r.CAMERA_MIN_PERIOD)),
        ]

    def _distance(self, m: Module, clocks: Signal, substeps: Value) -> Signal:
        """Clocks from one camera pulse to the next."""
        distance = Signal(27)
        per_line = self._file.field(r.LINE, "mode") == LineMode.PER_LINE
        m.d.sync += distance.eq(clocks)
        for count in SUBPHASES:
            with m.If(per_line & (substeps == count)):
                m.d.sync += distance.eq(_times(clocks, count))
        return distance

    def _phases(self, m: Module, substeps: Value) -> Signal:
        """Clocks of a sub-step's sub-phases."""
        needed, each = Signal(27), self._file.value(r.PHASE_CLOCKS)
        for substep_count, phase_count in SUBPHASES.items():
            with m.If(substeps == substep_count):
                m.d.sync += needed.eq(_times(each, phase_count))
        return needed

    def _pulse(
        self, m: Module, code: ErrorCode, output: r.Register, distance: Signal
    ) -> tuple[Condition, Condition]:
        delay, width = (getattr(r, f"{output.name}_{part}") for part in ("DELAY", "WIDTH"))
        end = Signal(25, name=f"{output.name.lower()}_end")
        m.d.sync += end.eq(self._file.value(delay) + self._file.value(width))
        enabled = self._file.field(output, "enable")
        return (
            (code, width, enabled & (self._file.value(width) == 0)),
            (code, delay, enabled & (end >= distance)),
        )


def _times(value: Value, factor: int) -> Value:
    """Multiply by 1, 2, 3 or 6 with shifts and one addition, without a multiplier."""
    once = value if factor in {1, 2} else value + (value << 1)
    return once << 1 if factor in {2, 6} else once
