r"""The clocks of a three-phase TDI sensor: six sub-phases per line move the charge, 6/S of them per sub-step.

::

    line     /‾\______________________________________/‾\       S = 3: two sub-phases in each sub-step
    substep  /‾\__________/‾\__________/‾\____________/‾\
    phase      0   | 1      2   | 3      4   | 5        0       the first lasts ``phase_clocks``, the last
    P1       ‾‾‾‾‾‾‾‾‾\_____________________/‾‾‾‾‾‾‾‾‾‾‾‾       of a sub-step takes the rest of it
    P2       ____/‾‾‾‾‾‾‾‾‾‾‾‾\_________________________
    P3       ______________/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\_______

``backwards`` goes through the same six from the last to the first: the charge moves the other way.
"""

from amaranth.hdl import Array, Elaboratable, Module, Mux, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

PATTERN = (0b001, 0b011, 0b010, 0b110, 0b100, 0b101)
"""Levels of P3 P2 P1 in the six sub-phases; one changes at a time."""
SUBPHASES = {1: 6, 2: 3, 3: 2, 6: 1}
"""S → sub-phases in a sub-step."""


class Phases(wiring.Component):
    """``phase_clocks`` = 0: the clocks rest low, for cameras that generate their own."""

    running: In(1)
    substep: In(1)
    line: In(1)
    substeps: In(3)
    phase_clocks: In(24)
    backwards: In(1)
    phases: Out(3)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        phase, left, more = Signal(range(6)), Signal(24), Signal(3)
        on, moving = Signal(), Signal()
        ahead = Array(SUBPHASES.get(s, 1) - 1 for s in range(8))
        levels, mirrored = Array(PATTERN), Array(reversed(PATTERN))
        m.d.comb += on.eq(self.running & (self.phase_clocks != 0))
        m.d.sync += self.phases.eq(Mux(moving, Mux(self.backwards, mirrored[phase], levels[phase]), 0))
        with m.If(~on):
            m.d.sync += [phase.eq(5), more.eq(0), moving.eq(0)]  # the sub-phase before the first of a line
        with m.Elif(self.substep):
            m.d.sync += [left.eq(self.phase_clocks - 1), more.eq(ahead[self.substeps]), moving.eq(1)]
            self._next(m, phase, self.line)
        with m.Elif((more != 0) & (left == 0)):
            m.d.sync += [left.eq(self.phase_clocks - 1), more.eq(more - 1)]
            self._next(m, phase, 0)
        with m.Else():
            m.d.sync += left.eq(left - 1)
        return m

    def _next(self, m: Module, phase: Signal, restart: object) -> None:
        m.d.sync += phase.eq(Mux(restart | (phase == 5), 0, phase + 1))
