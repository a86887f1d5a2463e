r"""The light: code bit AND window AND scene gate.

::

    advance  /‾\__________________/‾\__________________      one per sub-step, ``lead`` + 1 clocks ahead of it
    bit      X b0                   X b1
    clock    --- 0  1  2  3  4  5  6  0  1  2  3  4  5
    led      ________/‾‾‾‾‾‾‾‾‾\___________/‾‾‾‾‾‾‾‾‾\_      window_open = 2, window_close = 5; b0 = b1 = 1

``led`` comes two clocks after the bit's register: apart from the lead, it follows its sub-step as late as a
camera pulse without delay follows its line.
"""

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out


class Light(wiring.Component):
    advance: In(1)
    ending: In(1)
    """With ``advance``: the run ends, stay dark."""
    code_bit: In(1)
    """Sampled with ``advance``."""
    enable: In(1)
    inverted: In(1)
    window_open: In(24)
    window_close: In(24)
    scene_enable: In(1)
    scene_gate: In(1)
    """From outside, already in this clock's domain."""
    lit: Out(1)
    """The sub-step's code bit, before the window and the gates."""
    led: Out(1)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        clock, shown, glows = Signal(24), Signal(), Signal()
        with m.If(self.advance):
            m.d.sync += [self.lit.eq(self.code_bit & ~self.ending), clock.eq(0)]
        with m.Else():
            m.d.sync += clock.eq(clock + 1)
        window = (clock >= self.window_open) & (clock < self.window_close)
        gate = ~self.scene_enable | self.scene_gate
        m.d.sync += [
            shown.eq(self.lit & window & self.enable),
            glows.eq(shown & gate),
        ]
        m.d.comb += self.led.eq(glows ^ self.inverted)  # dark from power-up on, whichever level that is
        return m
