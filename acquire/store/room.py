"""Free space of the disk, and how long it lasts."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.store.files import Disk

LOOK_S = 0.5
"""Interval of the queries."""

MEMORY_S = 20.0
"""Time over which the rate is averaged."""


@dataclass(frozen=True, slots=True)
class Room:
    """A disk at one moment: bytes free above the reserve, and bytes written per second.

    ``soon_bytes`` are expected to be written, by everybody, until the next look.
    """

    free_bytes: int
    bytes_per_s: float
    soon_bytes: int = 0

    @property
    def seconds_to_full(self) -> float:
        """Seconds until the disk is full; infinite while nothing is written."""
        return max(0, -self.missing_bytes) / self.bytes_per_s if self.bytes_per_s > 0 else float("inf")

    @property
    def missing_bytes(self) -> int:
        """Bytes by which the disk falls short of the reserve until the next look; negative: it does not."""
        return self.soon_bytes - self.free_bytes

    @property
    def full(self) -> bool:
        """Whether nothing would be left but the reserve."""
        return self.missing_bytes >= 0


class RoomWatch:
    """Queries the disk of ``path`` from time to time; ``reserve_bytes`` of it are to stay free."""

    def __init__(self, disk: Disk, path: Path, reserve_bytes: int) -> None:
        self._disk = disk
        self._path = path
        self._reserve = reserve_bytes
        self._begun_s = self._due_s = time.monotonic()
        self._bytes = 0
        self._rate = 0.0
        self.room = Room(2**63, 0.0)  # until the first query, nothing is known to be short

    def look(self, bytes_written: int) -> Room:
        """Return the disk's room after ``bytes_written``; queried once per `LOOK_S`. Raises OSError."""
        now = time.monotonic()
        if now >= self._due_s:
            # Not 0 at the first query, which comes at once.
            elapsed = max(1e-3, now - self._begun_s)
            # An exponential mean, beginning with the first value.
            share = min(1.0, max(LOOK_S, elapsed) / MEMORY_S) if self._bytes else 1.0
            self._rate += share * ((bytes_written - self._bytes) / elapsed - self._rate)
            free = self._disk.free_bytes(self._path) - self._reserve
            # A fast camera, a busy host or a second recording take more between two looks than many reserves.
            # Retention frees what this recording writes, so that its own bytes count as well as the fall.
            soon = max(bytes_written - self._bytes, self.room.free_bytes - free if self._bytes else 0)
            self._bytes, self._begun_s, self._due_s = bytes_written, now, now + LOOK_S
            self.room = Room(free, self._rate, soon)
        return self.room
