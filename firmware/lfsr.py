r"""The pseudo-random code: a Galois register that shifts right, the twin of `acquire.codes.prbs`.

::

    clk    _/‾\_/‾\_/‾\_/‾\_/‾\_
    load   _/‾‾‾\_______________
    step   _________/‾‾‾\_/‾‾‾\_
    state  ?????X seed  X s1  X s2        bit = state[0]: the bit of the index reached
"""

from amaranth.hdl import Elaboratable, Module, Mux
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

WIDTH = 64


class Lfsr(wiring.Component):
    """bit = state & 1; state >>= 1; if bit: state ^= mask."""

    mask: In(WIDTH)
    seed: In(WIDTH)
    load: In(1)
    """Take the seed; wins over ``step``."""
    step: In(1)
    """Go to the next bit."""
    state: Out(WIDTH)
    bit: Out(1)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        m.d.comb += self.bit.eq(self.state[0])
        with m.If(self.load):
            m.d.sync += self.state.eq(self.seed)
        with m.Elif(self.step):
            m.d.sync += self.state.eq((self.state >> 1) ^ Mux(self.bit, self.mask, 0))
        return m
