r"""The watchdog: it ends a run whose host has fallen silent, from the run's first clock on.

::

    enable   ____/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\______      the run
    feed     ______________/‾\___________________________
    left       n X n-1 X .. X n X n-1 X ... X 1 X 0 X n
    bark     ______________________________________/‾‾‾‾\_     BARK_CLOCKS after the last of ``period`` silent
                                                              clocks, until the run is over

``bark`` is a level: a run cannot outlast it.
"""

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

BARK_CLOCKS = 2
"""Clocks from the last of ``period`` silent clocks to ``bark``."""


class Watchdog(wiring.Component):
    """``period`` in clocks, 0: off."""

    period: In(32)
    enable: In(1)
    feed: In(1)
    bark: Out(1)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        left, watching = Signal(32), Signal()
        m.d.sync += watching.eq(self.period != 0)  # configuration: it does not change during a run
        m.d.sync += self.bark.eq(self.enable & watching & (left == 0) & ~self.feed)
        # Filled while nothing runs, so that the first clock of a run has the whole period before it.
        with m.If(self.feed | ~self.enable):
            m.d.sync += left.eq(self.period)
        with m.Elif(left != 0):
            m.d.sync += left.eq(left - 1)
        return m
