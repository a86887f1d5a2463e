"""A link that damages bytes, and one that answers nothing; for tests of the host's side."""

from __future__ import annotations

import random
import time
from typing import NamedTuple

from acquire.errors import TriggerError
from acquire.sim.twin_links import Twin, TwinTransport
from acquire.trigger.frames import parse_write, read_payload
from acquire.trigger.link import Link
from acquire.trigger.registers import PRBS_SEED, FrameType


class Damage(NamedTuple):
    """Result of a storm."""

    wrong: int
    """Values that are not what was written."""
    given_up: int
    """Batches in which a request had no answer in time."""


class NoisyTransport(TwinTransport):
    """Change, drop or double each byte in both directions with probability ``rate``."""

    def __init__(self, twin: Twin, rate: float, seed: int) -> None:
        super().__init__(twin, "noisy link")
        self.rate, self.chance, self.damaged = rate, random.Random(seed), 0

    def read(self) -> bytes:
        return self._spoil(super().read())

    def write(self, data: bytes) -> None:
        super().write(self._spoil(data))

    def _spoil(self, data: bytes) -> bytes:
        if not self.rate:
            return data
        out = bytearray()
        for byte in data:
            if self.chance.random() >= self.rate:
                out.append(byte)
            else:
                self.damaged += 1
                out += self.chance.choice(
                    [b"", bytes([byte ^ self.chance.randrange(1, 256)]), bytes([byte, byte])]
                )
        return bytes(out)


class DeafTransport:
    """Accept everything and send nothing; `hang_up` ends it."""

    name = "deaf"
    bytes_per_s = float("inf")

    def __init__(self) -> None:
        self.error: TriggerError | None = None
        self.written = b""
        self.closed = 0

    def read(self) -> bytes:
        if self.error:
            raise self.error
        time.sleep(0.002)
        return b""

    def write(self, data: bytes) -> None:
        self.written += data

    def hang_up(self) -> None:
        self.error = TriggerError("deaf is gone")

    def close(self) -> None:
        self.closed += 1


def storm(link: Link, commands: int, batch: int = 250) -> Damage:
    """Write values and read them back on a bad link, in pipelined batches of one write and many reads."""
    wrong = given_up = 0
    for at in range(0, commands, batch):
        want = at + 1, ~(at + 1) & 0xFFFFFFFF
        try:
            link.write(PRBS_SEED.address, want)
            reads = [(FrameType.READ, read_payload(PRBS_SEED.address, 2))] * (min(batch, commands - at) - 1)
            answers = [parse_write(frame.payload)[1] for frame in link.transact(reads)]
        except TriggerError:
            given_up += 1
            continue
        wrong += sum(words != want for words in answers)
    return Damage(wrong, given_up)
