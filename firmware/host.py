r"""The host's requests, carried out one after the other, and tags, sent in between.

::

    deframer.frame   ──/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\─────/‾‾‾‾
    state              HEAD | CHECK | WORD.. | SEND |       a request is released once its answer is framed
    tags.valid       ───────/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\
    state                                       IDLE | SEND      then at least one tag has its turn

Everything to be sent goes through one shift register, with the next byte at its low end. A request that comes
while a tag is being sent waits in the receive queue before the deframer: neither can starve the other.
"""

from amaranth.hdl import Cat, Const, Elaboratable, Module, Mux, Signal, Value
from amaranth.lib import stream, wiring
from amaranth.lib.wiring import In, Out

from acquire.trigger.registers import (
    CODE_MEMORY,
    COMMAND,
    MAX_WORDS,
    PROTOCOL_VERSION,
    TAG_BYTES,
    ErrorCode,
    FrameType,
)
from firmware import codememory, deframer, registerfile
from firmware.registerfile import ADDRESS_BITS
from firmware.tagger import SEQUENCE_BITS, TAG_BITS

HEAD_BYTES = 7
"""Version, type, sequence, address and the count of a READ."""
SHIFT_BYTES = 4 + TAG_BYTES
READ_WAIT = max(codememory.READ_LATENCY, registerfile.READ_LATENCY)


class Host(wiring.Component):
    def __init__(self, code_words: int) -> None:
        self._code_words = code_words
        bits = (code_words - 1).bit_length()
        super().__init__(
            {
                # one received frame, see Deframer
                "frame": In(1),
                "length": In(8),
                "frame_address": Out(8),
                "frame_data": In(8),
                "release": Out(1),
                # one frame to send, see Framer
                "valid": Out(1),
                "ready": In(1),
                "data": Out(8),
                "last": Out(1),
                "tags": In(stream.Signature(SEQUENCE_BITS + TAG_BITS)),
                # registers, see RegisterFile
                "address": Out(ADDRESS_BITS),
                "known": In(1),
                "writable": In(1),
                "guarded": In(1),
                "sample": Out(1),
                "read_data": In(32),
                "write": Out(1),
                "write_data": Out(32),
                # commands, see Commands
                "idle": In(1),
                "execute": Out(1),
                "done": In(1),
                "error": In(16),
                "error_address": In(16),
                # code memory
                "code_address": Out(bits),
                "code_read": Out(1),
                "code_data": In(32),
                "code_write": Out(1),
                # a well-formed request has come
                "heard": Out(1),
            }
        )

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        self._head = Signal(8 * HEAD_BYTES)
        self._count, self._left = Signal(8), Signal(8)
        self._address, self._word = Signal(16), Signal(32)
        self._set = Signal()  # the word is not 0
        self._step, self._fetch = Signal(range(16)), Signal(8)
        self._shift, self._bytes, self.more = (
            Signal(8 * SHIFT_BYTES),
            Signal(range(SHIFT_BYTES + 1)),
            Signal(),
        )
        self.tag_turn = Signal()
        self._error, self._where = Signal(16), Signal(16)
        self._in_code = self._address[15]
        m.d.comb += [
            self.frame_address.eq(self._fetch),
            self.address.eq(self._address),
            self.code_address.eq(self._address),
            self.code_read.eq(self._in_code),
            self.write_data.eq(self._word),
            self.data.eq(self._shift[:8]),
            self.last.eq((self._bytes == 1) & ~self.more),
        ]
        self._inside = (
            Signal()
        )  # a clock behind the address, which has been constant for several clocks when it is used
        m.d.sync += [
            self._step.eq(self._step + 1),
            self._inside.eq(
                Mux(self._in_code, self._address[:15] < self._code_words, self._address < 1 << ADDRESS_BITS)
            ),
        ]
        with m.FSM() as fsm:
            states = (
                ("IDLE", self._idle),
                ("HEAD", self._read_head),
                ("CHECK", self._check),
                ("READ CHECK", self._check_read),
                ("READ", self._read),
                ("FETCH", self._fetch_word),
                ("WRITE", self._write),
                ("COMMAND", self._await_command),
                ("WRITTEN", self._written),
                ("NAK", self._nak),
                ("SEND", self._send),
                ("SENT", self._sent),
            )
            for name, state in states:
                with m.State(name):
                    state(m)
            self.within = {name: fsm.ongoing(name) for name, _ in states}  # for proofs
        return m

    def _idle(self, m: Module) -> None:
        m.d.sync += [self._step.eq(0), self._fetch.eq(0)]
        # A tag and a request in turns: neither is kept waiting by many of the other.
        with m.If(self.tags.valid & (self.tag_turn | ~self.frame)):
            m.d.comb += self.tags.ready.eq(1)
            m.d.sync += self.tag_turn.eq(0)
            self._send_tag(m)
        with m.Elif(self.frame):
            m.d.sync += self.tag_turn.eq(1)
            m.next = "HEAD"

    def _read_head(self, m: Module) -> None:
        m.d.sync += self._fetch.eq(self._fetch + 1)
        with m.If(self._step >= deframer.READ_LATENCY):
            m.d.sync += self._head.eq(Cat(self._head[8:], self.frame_data))
        with m.If(self._step == deframer.READ_LATENCY + HEAD_BYTES - 1):
            m.next = "CHECK"

    def _check(self, m: Module) -> None:
        """Check the form of the request, and find its type."""
        version, kind, asked = self._head[:8], self._head[8:16], self._head[48:56]
        payload = self.length - deframer.HEADER_BYTES
        words = (payload - 2)[2:8]
        # Sample the registers of several words now, all in one clock: read one after the other they would
        # belong to different moments.
        m.d.comb += self.sample.eq(1)
        m.d.sync += [
            self._address.eq(self._head[32:48]),
            self._step.eq(0),
            self._fetch.eq(deframer.HEADER_BYTES + 2),
        ]
        with m.If(version != PROTOCOL_VERSION):
            self._refuse(m, ErrorCode.BAD_VERSION, 0)
        with m.Elif(kind == FrameType.READ):
            self._accept(m, asked, (payload == 3) & (asked != 0) & (asked <= MAX_WORDS), "READ CHECK")
        with m.Elif(kind == FrameType.WRITE):
            # Two bytes of address, and whole words of four.
            self._accept(m, words, (payload >= 6) & (payload[:2] == 2), "FETCH")
        with m.Else():
            self._refuse(m, ErrorCode.BAD_TYPE, 0)

    def _accept(self, m: Module, words: Value, good: Value, follows: str) -> None:
        m.d.sync += [self._count.eq(words), self._left.eq(words)]
        with m.If(good):
            m.d.comb += self.heard.eq(1)
            m.next = follows
        with m.Else():
            self._refuse(m, ErrorCode.BAD_LENGTH, 0)

    def _check_read(self, m: Module) -> None:
        end, beyond = Signal(17), Signal()  # a bit more than addresses have: the sum must not wrap
        limit = Mux(self._in_code, CODE_MEMORY + self._code_words, 1 << ADDRESS_BITS)
        m.d.sync += [end.eq(self._address + self._count), beyond.eq(end > limit)]
        with m.If(self._step == 2):
            m.d.sync += self._step.eq(0)
            with m.If(beyond):
                self._refuse(m, ErrorCode.BAD_ADDRESS, self._address)
            with m.Elif(self._in_code & ~self.idle):
                self._refuse(m, ErrorCode.BUSY, self._address)
            with m.Else():
                self._answer(m, FrameType.DATA, self._address, 2, more=1)

    def _read(self, m: Module) -> None:
        with m.If(self._step == READ_WAIT):
            m.d.sync += [
                self._shift.eq(Mux(self._in_code, self.code_data, self.read_data)),
                self._bytes.eq(4),
                self.more.eq(self._left != 1),
                self._left.eq(self._left - 1),
                self._address.eq(self._address + 1),
            ]
            m.next = "SEND"

    def _fetch_word(self, m: Module) -> None:
        m.d.sync += self._fetch.eq(self._fetch + 1)
        with m.If(self._step >= deframer.READ_LATENCY):
            m.d.sync += self._word.eq(Cat(self._word[8:], self.frame_data))
            first = self._step == deframer.READ_LATENCY
            m.d.sync += self._set.eq((self._set & ~first) | self.frame_data.any())
        with m.If(self._step == deframer.READ_LATENCY + 3):
            # Back to the byte after the word: the address runs ahead of the data.
            m.d.sync += self._fetch.eq(self._fetch - (deframer.READ_LATENCY - 1))
            m.next = "WRITE"

    def _write(self, m: Module) -> None:
        hole = ~self._in_code & ~self.known
        m.d.sync += self._step.eq(0)
        with m.If(~self._inside | (hole & self._set)):
            self._refuse(m, ErrorCode.BAD_ADDRESS, self._address)
        with m.Elif(~self._in_code & self.known & ~self.writable):
            self._refuse(m, ErrorCode.READ_ONLY, self._address)
        with m.Elif((self._in_code | self.guarded) & ~self.idle):
            self._refuse(m, ErrorCode.BUSY, self._address)
        with m.Else():
            m.d.comb += [
                self.write.eq(~self._in_code & ~hole),
                self.code_write.eq(self._in_code),
                self.execute.eq(self._address == COMMAND.address),
            ]
            m.next = "WRITTEN"
            with m.If(self.execute):
                m.next = "COMMAND"

    def _await_command(self, m: Module) -> None:
        with m.If(self.done):
            m.next = "WRITTEN"
            with m.If(self.error != 0):
                self._refuse(m, self.error, self.error_address)

    def _written(self, m: Module) -> None:
        begun = self._address - self._count + 1
        m.d.sync += [
            self._step.eq(0),
            self._left.eq(self._left - 1),
            self._address.eq(self._address + 1),
        ]
        m.next = "FETCH"
        with m.If(self._left == 1):
            self._answer(m, FrameType.ACK, Cat(begun[:16], self._count), 3, more=0)

    def _nak(self, m: Module) -> None:
        self._answer(m, FrameType.NAK, Cat(self._error, self._where), 4, more=0)

    def _send(self, m: Module) -> None:
        m.d.comb += self.valid.eq(1)
        m.d.sync += self._step.eq(0)
        with m.If(self.ready):
            m.d.sync += [self._shift.eq(self._shift >> 8), self._bytes.eq(self._bytes - 1)]
            with m.If(self._bytes == 1):
                m.next = "READ"
                with m.If(~self.more):
                    m.next = "SENT"

    def _sent(self, m: Module) -> None:
        # High where the frame's answer was sent; a tag leaves the frame for the next turn.
        m.d.comb += self.release.eq(self.tag_turn)
        m.d.sync += self._address.eq(0)
        m.next = "IDLE"

    def _answer(self, m: Module, kind: FrameType, payload: Value, size: int, more: int) -> None:
        sequence = self._head[16:32]
        frame = Cat(Const(PROTOCOL_VERSION, 8), Const(kind, 8), sequence, payload)
        m.d.sync += [self._shift.eq(frame), self._bytes.eq(4 + size), self.more.eq(more)]
        m.next = "SEND"

    def _refuse(self, m: Module, error: Value | ErrorCode, address: Value | int) -> None:
        m.d.sync += [self._error.eq(error), self._where.eq(address)]
        m.next = "NAK"

    def _send_tag(self, m: Module) -> None:
        m.d.sync += [
            self._shift.eq(Cat(Const(PROTOCOL_VERSION, 8), Const(FrameType.TAG, 8), self.tags.payload)),
            self._bytes.eq(SHIFT_BYTES),
            self.more.eq(0),
        ]
        m.next = "SEND"
