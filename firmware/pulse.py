r"""One camera's trigger output: a pulse per request, after ``delay`` clocks and ``width`` clocks long.

::

    clk     _/‾\_/‾\_/‾\_/‾\_/‾\_/‾\_/‾\_
    fire    _/‾‾‾\_______________________
    begin   _________/‾‾‾\_______________       delay = 1, width = 2
    level   _________________/‾‾‾‾‾‾‾\___

``level`` rises ``delay + 2`` clocks after ``fire``. The limits that arming checks (delay + width shorter than
the period of the pulses) keep a request from meeting an unfinished pulse; if one does, the new pulse wins.
"""

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

WIDTH = 24


class Pulse(wiring.Component):
    fire: In(1)
    enable: In(1)
    delay: In(WIDTH)
    width: In(WIDTH)
    inverted: In(1)
    begin: Out(1)
    """One clock per pulse, just before ``level``."""
    level: Out(1)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        wait, hold, waiting, active = Signal(WIDTH), Signal(WIDTH), Signal(), Signal()
        m.d.sync += self.level.eq(active ^ self.inverted)
        m.d.comb += self.begin.eq(active & (hold == self.width))
        # A request takes precedence: the rest of an earlier pulse is abandoned.
        with m.If(self.fire & self.enable):
            m.d.sync += [wait.eq(self.delay - 1), waiting.eq(self.delay != 0), active.eq(self.delay == 0)]
            m.d.sync += hold.eq(self.width)
        with m.Elif(waiting):
            m.d.sync += wait.eq(wait - 1)
            with m.If(wait == 0):
                m.d.sync += [waiting.eq(0), active.eq(1)]
        with m.Elif(active):
            m.d.sync += [hold.eq(hold - 1), active.eq(hold != 1)]
        return m
