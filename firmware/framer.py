"""Frames → bytes of the link: CRC-32 appended, COBS applied in place, delimiter added.

::

    valid, ready  bytes of version, type, sequence, payload; `last` marks the final one
    memory        [code] b b b [code] b b ... crc×4 [00]
    bytes         sent once the frame is whole; no byte is taken during that time

COBS in one pass: the place of the code byte is reserved and filled in at the next zero (or the end), so that
every byte takes one write. It requires frames shorter than 254 bytes.
"""

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import stream, wiring
from amaranth.lib.memory import Memory
from amaranth.lib.wiring import In, Out

from firmware.crc import Crc32

MEMORY_BYTES = 256


class Framer(wiring.Component):
    valid: In(1)
    ready: Out(1)
    data: In(8)
    last: In(1)
    bytes: Out(stream.Signature(8))

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        m.submodules.memory = memory = Memory(shape=8, depth=MEMORY_BYTES, init=[])
        m.submodules.crc = crc = Crc32()
        write, read = memory.write_port(), memory.read_port()
        code_at, end, sent, step = Signal(8), Signal(8, init=1), Signal(8), Signal(2)
        put, byte = Signal(), Signal(8)
        m.d.comb += read.addr.eq(sent)
        with m.FSM():
            with m.State("TAKE"):
                m.d.comb += [
                    self.ready.eq(1),
                    put.eq(self.valid),
                    byte.eq(self.data),
                    crc.enable.eq(self.valid),
                    crc.data.eq(self.data),
                ]
                with m.If(self.valid & self.last):
                    m.d.sync += step.eq(0)
                    m.next = "CRC"
            with m.State("CRC"):
                m.d.comb += [put.eq(1), byte.eq(crc.value.word_select(step, 8))]
                m.d.sync += step.eq(step + 1)
                with m.If(step == 3):
                    m.next = "CLOSE"
            with m.State("CLOSE"):
                m.d.comb += [crc.reset.eq(1), put.eq(1), byte.eq(0)]
                m.next = "DELIMIT"
            with m.State("DELIMIT"):
                # The byte at code_at is the delimiter's place now: `put` of a zero moved it there.
                m.d.comb += [write.en.eq(1), write.addr.eq(code_at), write.data.eq(0)]
                m.d.sync += sent.eq(0)
                m.next = "ADDRESS"
            with m.State("ADDRESS"):
                m.next = "FETCH"
            with m.State("FETCH"):
                m.d.sync += [self.bytes.payload.eq(read.data), self.bytes.valid.eq(1)]
                m.next = "SEND"
            with m.State("SEND"):
                with m.If(self.bytes.ready):
                    m.d.sync += [self.bytes.valid.eq(0), sent.eq(sent + 1)]
                    m.next = "ADDRESS"
                    with m.If(sent == code_at):
                        m.d.sync += [code_at.eq(0), end.eq(1)]
                        m.next = "TAKE"
        with m.If(put):
            m.d.comb += write.en.eq(1)
            m.d.sync += end.eq(end + 1)
            with m.If(byte == 0):
                m.d.comb += [write.addr.eq(code_at), write.data.eq(end - code_at)]
                m.d.sync += code_at.eq(end)
            with m.Else():
                m.d.comb += [write.addr.eq(end), write.data.eq(byte)]
        return m
