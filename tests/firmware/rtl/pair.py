"""Gateware and behavioural model side by side: every request goes to both."""

from __future__ import annotations

from device_bench import Bench

from acquire.sim.clock import Wire
from acquire.sim.trigger_model import TriggerModel
from acquire.trigger import registers as r
from acquire.trigger.frames import Decoder, Frame, encode, parse_write, read_payload, write_payload
from acquire.trigger.registers import FrameType

CLOCK_HZ = 1_000_000_000
"""The model's: a clock per ns."""


class HandClock:
    """Clock that is advanced by hand."""

    def __init__(self) -> None:
        self.now_ns = 1000

    def monotonic_ns(self) -> int:
        return self.now_ns

    def utc_ns(self) -> int:
        return self.now_ns

    def sleep(self, duration_s: float) -> None:
        raise AssertionError("the model waits")


class Pair:
    """Gateware and model; every request goes to both, and the answers must be equal."""

    def __init__(self, device: Bench) -> None:
        self.device, self.clock = device, HandClock()
        self.wire = Wire(self.clock)
        self.model = TriggerModel(self.wire, CLOCK_HZ)
        self._decoder = Decoder()
        self._sequence = 0
        self.tags: list[tuple[int, r.TagRecord]] = []

    def ask(self, kind: int, payload: bytes, compare: bool = True) -> tuple[Frame, Frame]:
        """Return the two answers."""
        self._sequence += 1
        theirs = self.device.ask(kind, payload)
        self.model.feed(encode(Frame(kind, self._sequence, payload)))
        (mine,) = self.take()
        assert not compare or (mine.type, mine.payload) == (theirs.type, theirs.payload), (mine, theirs)
        return theirs, mine

    def take(self) -> list[Frame]:
        """Return the answers of the model; its tags are collected."""
        frames = self._decoder.feed(self.model.take())
        self.tags += [(f.sequence, r.unpack_tag(f.payload)) for f in frames if f.type == FrameType.TAG]
        return [frame for frame in frames if frame.type != FrameType.TAG]

    def write(self, address: int, words: list[int]) -> bool:
        """Return whether it was accepted."""
        return self.ask(FrameType.WRITE, write_payload(address, words))[0].type == FrameType.ACK

    def command(self, command: int, run: int = 0) -> bool:
        return self.write(r.RUN_ID.address, [*r.RUN_ID.to_words(run), command])

    def read(self, register: r.Register, compare: bool = True) -> tuple[int, int]:
        """Return the values read from the gateware and the model."""
        answers = self.ask(FrameType.READ, read_payload(register.address, register.words), compare)
        gateware, model = (
            sum(word << 32 * i for i, word in enumerate(parse_write(answer.payload)[1])) for answer in answers
        )
        return gateware, model
