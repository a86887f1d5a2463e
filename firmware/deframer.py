r"""Bytes of the link → frames: COBS decoded, CRC-32 checked, one frame kept until it is released.

::

    bytes    c0 d d d c1 d d ... 00                  00 ends a frame, whatever came before
    memory      d d d 0  d d ... crc crc crc crc
    frame    __________________________/‾‾‾‾‾‾‾\___   high from the delimiter until `release`
    ready    ‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\_______/‾‾‾   until then bytes wait outside, none is lost

A frame that is too long, too short or cut, or has a wrong checksum, is dropped and counted (``bad``).
"""

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import stream, wiring
from amaranth.lib.memory import Memory
from amaranth.lib.wiring import In, Out

from firmware.crc import RESIDUE, Crc32

HEADER_BYTES = 4
CRC_BYTES = 4
MEMORY_BYTES = 256
READ_LATENCY = 2
"""Clocks from ``address`` to ``data``."""


class Deframer(wiring.Component):
    """``length`` counts header and payload, without the CRC."""

    bytes: In(stream.Signature(8))
    frame: Out(1)
    length: Out(8)
    address: In(8)
    data: Out(8)
    release: In(1)
    bad: Out(1)
    """High for one clock per frame dropped."""

    def __init__(self, max_payload: int) -> None:
        self._longest = HEADER_BYTES + max_payload + CRC_BYTES
        super().__init__()

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        m.submodules.memory = memory = Memory(shape=8, depth=MEMORY_BYTES, init=[])
        m.submodules.crc = crc = Crc32()
        write, read = memory.write_port(), memory.read_port()
        left, count = Signal(8), Signal(9)
        begun, follow_zero, broken = Signal(), Signal(), Signal()
        emit, byte = Signal(), self.bytes.payload
        m.d.comb += [
            self.bytes.ready.eq(~self.frame),
            read.addr.eq(self.address),
            write.addr.eq(count),
            write.en.eq(emit & ~broken),
            crc.enable.eq(emit),
            crc.data.eq(write.data),
        ]
        m.d.sync += [self.data.eq(read.data), self.bad.eq(0)]
        with m.If(self.release):
            m.d.sync += self.frame.eq(0)
        with m.If(self.bytes.valid & self.bytes.ready):
            with m.If(byte == 0):
                # The CRC runs over the frame's own CRC as well, and is the same constant for every whole one.
                good = ~broken & (left == 0) & (count >= HEADER_BYTES + CRC_BYTES) & (crc.value == RESIDUE)
                m.d.comb += crc.reset.eq(1)
                m.d.sync += [
                    self.frame.eq(good),
                    self.bad.eq(begun & ~good),
                    self.length.eq(count - CRC_BYTES),
                    count.eq(0),
                    left.eq(0),
                    begun.eq(0),
                    broken.eq(0),
                ]
            with m.Elif(left == 0):
                # COBS omits a zero after each block, except after full blocks of 254 bytes.
                m.d.comb += [emit.eq(begun & follow_zero), write.data.eq(0)]
                m.d.sync += [left.eq(byte - 1), begun.eq(1), follow_zero.eq(byte != 0xFF)]
            with m.Else():
                m.d.comb += [emit.eq(1), write.data.eq(byte)]
                m.d.sync += left.eq(left - 1)
            with m.If(emit):
                m.d.sync += count.eq(count + 1)
                with m.If(count == self._longest):
                    m.d.sync += [broken.eq(1), count.eq(count)]  # of two assignments, the later one counts
        return m
