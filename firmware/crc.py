r"""CRC-32 as zlib computes it, a byte per clock.

::

    clk     _/‾\_/‾\_/‾\_/‾\_
    reset   _/‾‾‾\___________
    enable  _____/‾‾‾‾‾‾‾\___
    data    -----X b0X b1X---
    value   ?????X 0 X c1X c2        zlib.crc32 of the bytes so far
"""

from amaranth.hdl import Cat, Elaboratable, Module, Signal, Value
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

POLYNOMIAL = 0xEDB88320
RESIDUE = 0x2144DF1C
"""The value after any bytes followed by their own CRC, little endian."""


class Crc32(wiring.Component):
    reset: In(1)
    enable: In(1)
    data: In(8)
    value: Out(32)

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        state = Signal(32, init=0xFFFFFFFF)
        m.d.comb += self.value.eq(~state)
        with m.If(self.reset):
            m.d.sync += state.eq(0xFFFFFFFF)
        with m.Elif(self.enable):
            m.d.sync += state.eq(_advance(state, self.data))
        return m


def _advance(state: Signal, data: Value) -> Value:
    """Eight steps of the register, unrolled as one network of XORs."""
    bits = [state[i] ^ data[i] if i < 8 else state[i] for i in range(32)]
    for _ in range(8):
        out = bits[0]
        bits = [*bits[1:], 0]
        bits = [bits[i] ^ out if POLYNOMIAL >> i & 1 else bits[i] for i in range(32)]
    return Cat(*bits)
