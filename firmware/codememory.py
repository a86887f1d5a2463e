r"""The loaded code: bits by index out of block RAM, CRC-32 of what is stored, and read-back for the host.

A bit takes four clocks from its index, and no sub-step is shorter than five: no prefetch is needed::

    clk      0     1     2     3     4     5
    step    _/‾‾‾‾\________________________/‾
    index    k    X k+1                     X k+2        (back to 0 after length − 1)
    address       X (k+1) / 32
    RAM                 X word
    register                  X word                      every block-RAM output is registered
    bit                             X bit k+1

The read port belongs to the player while ``busy`` is low and to the CRC (one word in four clocks) while it
is high; the host borrows it for read-back when nothing runs.
"""

from amaranth.hdl import Array, Elaboratable, Module, Signal
from amaranth.lib import wiring
from amaranth.lib.memory import Memory
from amaranth.lib.wiring import In, Out

from firmware.crc import Crc32

WORDS = 1 << 14
"""512 kbit."""
READ_LATENCY = 3
"""Clocks from ``host_address`` to ``host_data``."""


class CodeMemory(wiring.Component):
    """``words`` × 32 bits; bit k of the code is bit k % 32 of word k // 32."""

    def __init__(self, words: int = WORDS) -> None:
        self.words = words
        bits = (words - 1).bit_length()
        super().__init__(
            {
                "length": In(bits + 6),  # code length in bits, 1 to 32 * words
                "load": In(1),  # go to index 0
                "step": In(1),  # go to the next index
                "bit": Out(1),
                "write": In(1),
                "write_address": In(bits),
                "write_data": In(32),
                "host_read": In(1),  # the read port is the host's while this is high
                "host_address": In(bits),
                "host_data": Out(32),
                "check": In(1),  # compute the CRC of the words that hold `length` bits
                "busy": Out(1),
                "crc": Out(32),  # zlib's CRC-32 of these words, little endian
            }
        )

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        m.submodules.memory = memory = Memory(shape=32, depth=self.words, init=[])
        write, read = memory.write_port(), memory.read_port()
        index = Signal(len(self.length))
        word = Signal(32)
        scan = Signal(len(self.write_address) + 1)
        m.d.comb += [
            write.addr.eq(self.write_address),
            write.data.eq(self.write_data),
            write.en.eq(self.write),
            self.host_data.eq(word),
        ]
        m.d.sync += [word.eq(read.data), self.bit.eq(Array(word)[index[:5]])]
        with m.If(self.busy):
            m.d.comb += read.addr.eq(scan)
        with m.Elif(self.host_read):
            m.d.comb += read.addr.eq(self.host_address)
        with m.Else():
            m.d.comb += read.addr.eq(index[5:])
        with m.If(self.load):
            m.d.sync += index.eq(0)
        with m.Elif(self.step):
            m.d.sync += index.eq(index + 1)
            with m.If(index + 1 == self.length):
                m.d.sync += index.eq(0)
        self._check(m, word, scan)
        return m

    def _check(self, m: Module, word: Signal, scan: Signal) -> None:
        """Compute the CRC, a byte per clock: a word of ``scan`` is there before its first byte is due."""
        m.submodules.crc = crc = Crc32()
        phase = Signal(3)
        m.d.comb += [self.crc.eq(crc.value), crc.data.eq(word.word_select(phase[:2], 8))]
        with m.If(self.check & ~self.busy):
            m.d.comb += crc.reset.eq(1)
            m.d.sync += [self.busy.eq(1), scan.eq(0), phase.eq(0)]
        with m.Elif(self.busy):
            m.d.sync += phase.eq(phase + 1)
            m.d.comb += crc.enable.eq(phase[2])
            with m.If(phase == 7):
                m.d.sync += scan.eq(scan + 1)
                with m.If(scan + 1 == (self.length + 31) >> 5):
                    m.d.sync += self.busy.eq(0)
