"""A sensor for simulated GenTL cameras whose every pixel says which line it is of."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from acquire.camera.base import CameraBlock

WIDTH = 48
BLOCK = 50


def ramp(lines: np.ndarray, width: int = WIDTH, bits: int = 12) -> np.ndarray:
    """(line, pixel)"""
    return ((lines[:, None] * 7 + np.arange(width) * 3) % (1 << bits)).astype(np.uint16)


@dataclass(frozen=True)
class RampOpener:
    """Lines at ``rate_hz`` from arm on, ``limit`` of them at most."""

    rate_hz: float = 20_000.0
    limit: int = 1 << 40
    width: int = WIDTH

    def __call__(self) -> RampSensor:
        return RampSensor(self)


class RampSensor:
    def __init__(self, given: RampOpener) -> None:
        self.given = given
        self.next_line = self.start_ns = 0

    def arm(self) -> None:
        self.next_line = 0
        self.start_ns = time.monotonic_ns()

    def disarm(self) -> None:
        """Nothing to stop."""

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        due = int((time.monotonic_ns() - self.start_ns) * self.given.rate_hz / 1e9)
        if min(due, self.given.limit) < self.next_line + BLOCK:
            time.sleep(0.001)
            return None
        lines = np.arange(self.next_line, self.next_line + BLOCK)
        self.next_line += BLOCK
        return CameraBlock(int(lines[0]), ramp(lines, self.given.width), np.zeros(BLOCK, np.uint16))

    def times_ns(self, first_line: int, count: int) -> Any:
        return self.start_ns + (np.arange(first_line, first_line + count) * 1e9 / self.given.rate_hz).astype(
            np.int64
        )
