r"""Stops a run whose host has gone silent.

::

    feed     __/‾\____________________________
    left     ..X n X n-1 X ... X 1 X 0
    bark     ____________________________/‾\__      one clock; only while ``enable``
"""

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out


class Watchdog(wiring.Component):
    """``period`` in clocks, 0: off."""

    period: In(32)
    enable: In(1)
    feed: In(1)
    bark: Out(1)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        left, watching = Signal(32), Signal()
        m.d.sync += self.bark.eq(0)
        with m.If(self.feed | ~self.enable | (self.period == 0)):
            m.d.sync += [left.eq(self.period), watching.eq(self.enable & (self.period != 0))]
        with m.Elif(watching & (left == 0)):
            m.d.sync += [self.bark.eq(1), watching.eq(0)]
        with m.Elif(watching):
            m.d.sync += left.eq(left - 1)
        return m
