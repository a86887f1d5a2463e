r"""48-bit time in clocks since power-up, and its value at the latest pulse-per-second edge.

::

    now        100 X 101 X 102 X 103
    edge       ________/‾‾‾\________
    pps_time                 X 102
    pps_count   0            X 1
"""

from amaranth.hdl import Elaboratable, Module
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

from acquire.trigger.registers import TIME_BITS


class Timestamp(wiring.Component):
    """48 bits at 90 MHz last 36 days."""

    edge: In(1)
    now: Out(TIME_BITS)
    pps_time: Out(TIME_BITS)
    pps_count: Out(32)
    pps_seen: Out(1)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        m.d.sync += self.now.eq(self.now + 1)
        with m.If(self.edge):
            m.d.sync += [
                self.pps_time.eq(self.now),
                self.pps_count.eq(self.pps_count + 1),
                self.pps_seen.eq(1),
            ]
        return m
