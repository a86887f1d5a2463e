r"""An input from outside: brought into this clock's domain, its active edge found.

::

    pin     ____/‾‾‾‾‾‾‾‾‾‾‾‾     any phase
    level   ____________/‾‾‾‾     two clocks of synchroniser
    edge    ____________/‾\__
"""

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import wiring
from amaranth.lib.cdc import FFSynchronizer
from amaranth.lib.wiring import In, Out

LATENCY = 2
"""Clocks from pin to ``edge``."""


class Input(wiring.Component):
    pin: In(1)
    inverted: In(1)
    level: Out(1)
    edge: Out(1)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        raw, before = Signal(), Signal()
        # Two registers: the first may be neither 0 nor 1 for a while, if the pin changes at a clock edge.
        m.submodules.sync = FFSynchronizer(self.pin, raw, stages=LATENCY)
        m.d.comb += [self.level.eq(raw ^ self.inverted), self.edge.eq(self.level & ~before)]
        m.d.sync += before.eq(self.level)
        return m
