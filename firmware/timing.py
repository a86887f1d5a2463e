r"""The time base: sub-steps, lines and the instants at which the light advances to its next code bit.

::

    clk         0   1   2   3   4   5   6   7   8   9   10  11  12  13        substep_clocks = 5, S = 2
    start     _/‾\_____________________________________________________       lead = 1
    running   ___/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾
    advance   ____/‾‾‾\_______________/‾‾‾\_______________/‾‾‾\________       lead + 1 clocks before it
    substep   ____________/‾‾‾\_______________/‾‾‾\_______________/‾‾‾\       first clock of every sub-step
    line      ____________/‾‾‾\___________________________________/‾‾‾       first clock of every S-th

Clock 0 of a run is that of its first ``substep``: START_CLOCKS + lead after ``start``.
The ``advance`` at the end of a line decides whether it was the last one, so that the light never begins a
sub-step that does not come. A stop therefore takes effect after a whole line.
"""

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

CLOCK_BITS = 24
LEAD_BITS = 8
START_CLOCKS = 2
SUBSTEP_CLOCKS_MIN = 5
"""The bit of a loaded code comes four clocks after its index: see `firmware.codememory`."""


class Timing(wiring.Component):
    """Settings must be constant while ``running``, which the host's side ensures."""

    substep_clocks: In(CLOCK_BITS)
    substeps: In(3)
    """S; code bits per line."""
    lead: In(LEAD_BITS)
    """Below ``substep_clocks``."""
    lines: In(48)
    """Number of lines of the run; 0: until stopped."""
    start: In(1)
    stop: In(1)
    """May come at any time and be as short as one clock."""

    running: Out(1)
    advance: Out(1)
    ending: Out(1)
    """With ``advance``: nothing follows, the light goes off."""
    line_comes: Out(1)
    """With ``advance``: the sub-step it leads to begins a line."""
    last_line: Out(1)
    """The line that runs uses up ``lines``."""
    substep: Out(1)
    line: Out(1)
    place: Out(3)
    """Sub-step within its line."""
    line_number: Out(48)
    """With ``line``: the number of the line that begins."""
    code_index: Out(64)
    """With ``substep``: index of the code bit of the sub-step that begins."""

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        left = Signal(CLOCK_BITS)
        leading, stopping, leaving = Signal(), Signal(), Signal()
        last_place, last_is_next = Signal(), Signal()
        m.d.comb += [
            last_place.eq(self.place + 1 == self.substeps),
            self.advance.eq(self.running & (left == self.lead)),
            self.line_comes.eq(leading | (last_place & ~self.ending)),
            self.ending.eq(~leading & last_place & (stopping | self.stop | self.last_line)),
        ]
        m.d.sync += [
            self.substep.eq(0),
            self.line.eq(0),
            # A clock behind the number, which is constant for a line: five clocks at least.
            last_is_next.eq(self.line_number + 2 == self.lines),
        ]
        with m.If(self.stop & self.running):
            m.d.sync += stopping.eq(1)
        with m.If(self.advance):
            m.d.sync += leaving.eq(self.ending)
        with m.If(~self.running):
            with m.If(self.start):
                m.d.sync += [
                    self.running.eq(1),
                    self.last_line.eq(0),
                    leading.eq(1),
                    stopping.eq(0),
                    leaving.eq(0),
                    left.eq(self.lead),
                ]
        with m.Elif(left != 0):
            m.d.sync += left.eq(left - 1)
        with m.Elif(leading):
            m.d.sync += [leading.eq(0), self.line_number.eq(0), self.code_index.eq(0), self.place.eq(0)]
            m.d.sync += self.last_line.eq(self.lines == 1)
            self._begin(m, left, line=1)
        # According to the last advance, which may be in this very clock (lead = 0).
        with m.Elif(last_place & (leaving | (self.advance & self.ending))):
            m.d.sync += self.running.eq(0)
        with m.Else():
            m.d.sync += [
                self.code_index.eq(self.code_index + 1),
                self.place.eq(self.place + 1),
            ]
            with m.If(last_place):
                m.d.sync += [self.place.eq(0), self.line_number.eq(self.line_number + 1)]
                m.d.sync += self.last_line.eq(last_is_next)
            self._begin(m, left, line=last_place)
        return m

    def _begin(self, m: Module, left: Signal, line: object) -> None:
        m.d.sync += [left.eq(self.substep_clocks - 1), self.substep.eq(1), self.line.eq(line)]
