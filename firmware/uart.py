r"""UART, 8 data bits, no parity, one stop bit; every bit lasts ``divisor`` clocks exactly.

::

    line  ‾‾‾\____X=d0=X=d1=X ... X=d7=X‾stop‾‾‾‾      one bit = divisor clocks
    the receiver samples each bit in its middle; a byte whose stop bit is low is dropped, which the
    CRC of its frame reveals.
"""

from amaranth.hdl import Cat, Const, Elaboratable, Module, Signal
from amaranth.lib import stream, wiring
from amaranth.lib.cdc import FFSynchronizer
from amaranth.lib.wiring import In, Out


class UartReceiver(wiring.Component):
    """Serial line → bytes; ``valid`` is high for one clock per byte."""

    line: In(1, init=1)
    valid: Out(1)
    data: Out(8)

    def __init__(self, divisor: int) -> None:
        self.divisor = divisor
        super().__init__()

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        line = Signal(init=1)
        m.submodules.sync = FFSynchronizer(self.line, line, init=1)
        timer = Signal(range(2 * self.divisor))
        left = Signal(4)
        m.d.sync += self.valid.eq(0)
        with m.If(left == 0):
            with m.If(~line):
                m.d.sync += [left.eq(10), timer.eq(self.divisor // 2 - 1)]
        with m.Elif(timer != 0):
            m.d.sync += timer.eq(timer - 1)
        with m.Else():
            m.d.sync += [timer.eq(self.divisor - 1), left.eq(left - 1)]
            with m.If((left == 10) & line):
                m.d.sync += left.eq(0)  # a glitch, not a start bit
            with m.Elif(left == 1):
                m.d.sync += self.valid.eq(line)
            with m.Else():
                m.d.sync += self.data.eq(Cat(self.data[1:], line))
        return m


class UartTransmitter(wiring.Component):
    """Bytes → serial line."""

    bytes: In(stream.Signature(8))
    clear_to_send: In(1, init=1)
    """Low: no further byte is begun."""
    line: Out(1, init=1)

    def __init__(self, divisor: int) -> None:
        self.divisor = divisor
        super().__init__()

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        timer = Signal(range(self.divisor))
        left = Signal(4)
        shift = Signal(10, init=-1)
        m.d.sync += self.line.eq(shift[0])
        m.d.comb += self.bytes.ready.eq((left == 0) & self.clear_to_send)
        with m.If(left == 0):
            with m.If(self.bytes.valid & self.clear_to_send):
                m.d.sync += [
                    shift.eq(Cat(Const(0, 1), self.bytes.payload, Const(1, 1))),
                    left.eq(10),
                    timer.eq(self.divisor - 1),
                ]
        with m.Elif(timer != 0):
            m.d.sync += timer.eq(timer - 1)
        with m.Else():
            m.d.sync += [shift.eq(Cat(shift[1:], Const(1, 1))), left.eq(left - 1), timer.eq(self.divisor - 1)]
        return m
