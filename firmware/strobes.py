r"""Comparison of one camera's strobes with its trigger pulses: missed and unexpected strobes.

::

    pulse       /‾\_________/‾\_________/‾\_________/‾\
    strobe      ____/‾\_____________________/‾\_/‾\____
    missed                              +1
    unexpected                                  +1

A camera answers each pulse with exactly one strobe before the next.
"""

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out


class StrobeCheck(wiring.Component):
    strobe: In(1)
    """One clock per strobe."""
    enable: In(1)
    clear: In(1)
    pulse: In(1)
    """One clock per pulse sent."""
    seen: Out(32)
    missed: Out(32)
    unexpected: Out(32)
    first_missed: Out(1)
    """One clock, at the first of a run."""
    first_unexpected: Out(1)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        owed, miss, excess = Signal(), Signal(), Signal()
        m.d.comb += [
            miss.eq(self.pulse & owed & self.enable),
            excess.eq(self.strobe & ~owed & self.enable),
            self.first_missed.eq(miss & (self.missed == 0)),
            self.first_unexpected.eq(excess & (self.unexpected == 0)),
        ]
        with m.If(self.clear):
            m.d.sync += [self.seen.eq(0), self.missed.eq(0), self.unexpected.eq(0), owed.eq(0)]
        with m.Else():
            with m.If(self.pulse):
                m.d.sync += owed.eq(1)
            with m.Elif(self.strobe):
                m.d.sync += owed.eq(0)
            m.d.sync += [
                self.seen.eq(self.seen + (self.strobe & self.enable)),
                self.missed.eq(self.missed + miss),
                self.unexpected.eq(self.unexpected + excess),
            ]
        return m
