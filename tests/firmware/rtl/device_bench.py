"""One compiled device on the bench: requests answered at once, pins recorded clock by clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from acquire.trigger import registers as r
from acquire.trigger.frames import Decoder, Frame, encode, parse_nak, parse_write, read_payload, write_payload
from acquire.trigger.registers import Command, ErrorCode, FrameType, State, TagRecord
from firmware.cxxrtl import Pin, Twin
from firmware.top import Build

BUILD = Build(baud=11_250_000, serial=0x1234)
"""A quick link (eight clocks per bit); the rest is what a board gets. The driver's contract uses the same."""
TAG_FRAME_BYTES = len(encode(Frame(FrameType.TAG, 0, bytes(r.TAG_BYTES))))
RUN = {
    r.SUBSTEP_CLOCKS: 20,
    r.LINE: r.LINE.pack(substeps=3),
    r.WINDOW_CLOSE: 20,
    r.TRIGGER_A: r.TRIGGER_A.pack(enable=1),
    r.TRIGGER_A_WIDTH: 5,
    r.TAG_INTERVAL: 4,
}
"""Lines of 60 clocks, dark."""
ANSWER_CLOCKS = 100_000


class Bench:
    """Sequences are counted; tags are collected in ``tags`` with their sequences."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        self.decoder = Decoder()
        self.tags: list[tuple[int, TagRecord]] = []
        self.changes: list[tuple[int, Pin]] = []
        self.answers: list[Frame] = []
        self._sequence = 0

    def run(self, clocks: int) -> None:
        self.changes += self.twin.run(clocks)
        for frame in self.decoder.feed(self.twin.take()):
            if frame.type == FrameType.TAG:
                self.tags.append((frame.sequence, r.unpack_tag(frame.payload)))
            else:
                self.answers.append(frame)

    def send(self, kind: int, payload: bytes) -> None:
        self._sequence = self._sequence + 1 & 0xFFFF
        self.twin.feed(encode(Frame(kind, self._sequence, payload)))

    def ask(self, kind: int, payload: bytes) -> Frame:
        self.send(kind, payload)
        return self.answer()

    def answer(self) -> Frame:
        """The next answer; AssertionError when none comes."""
        limit = self.twin.clock + ANSWER_CLOCKS
        while not self.answers:
            assert self.twin.clock < limit, "no answer"
            self.run(500)
        return self.answers.pop(0)

    def read(self, register: r.Register) -> int:
        answer = self.ask(FrameType.READ, read_payload(register.address, register.words))
        assert answer.type == FrameType.DATA, parse_nak(answer.payload)
        return sum(word << 32 * i for i, word in enumerate(parse_write(answer.payload)[1]))

    def write(self, address: int, words: Sequence[int]) -> tuple[int, int] | None:
        """Return the error, or None."""
        answer = self.ask(FrameType.WRITE, write_payload(address, words))
        if answer.type == FrameType.ACK:
            return None
        error, where = parse_nak(answer.payload)
        return ErrorCode(error), where

    def put(self, register: r.Register, value: int) -> None:
        assert self.write(register.address, register.to_words(value)) is None, register.name

    def command(self, command: int, run: int = 0) -> tuple[int, int] | None:
        return self.write(r.RUN_ID.address, [*r.RUN_ID.to_words(run), command])

    @property
    def state(self) -> State:
        return State(r.STATUS.state.of(self.read(r.STATUS)))

    def finish(self, clocks: int) -> None:
        """Run until the run has ended and its last tag has arrived."""
        limit = self.twin.clock + clocks
        while not self.tags or not self.tags[-1][1].flags & r.TagFlag.LAST:
            assert self.twin.clock < limit, "the run does not end"
            self.run(1000)

    def levels(self, first: int, count: int) -> NDArray[np.uint16]:
        """Return the pins in every clock from ``first`` on."""
        clocks = np.array([clock for clock, _ in self.changes])
        pins = np.array([int(pins) for _, pins in self.changes], np.uint16)
        return pins[np.searchsorted(clocks, np.arange(first, first + count), side="right") - 1]


@contextmanager
def bench(build: Build = BUILD) -> Iterator[Bench]:
    twin = Twin(build)
    try:
        yield Bench(twin)
    finally:
        twin.close()


def start(device: Bench, values: dict[r.Register, int], run: int) -> None:
    """Configure, arm and start; TIME runs with the twin's clock."""
    for register, value in values.items():
        device.put(register, value)
    assert device.command(Command.ARM, run) is None
    device.changes.clear()
    device.changes.append((device.twin.clock, device.twin.pins))
    assert device.command(Command.START, run) is None
