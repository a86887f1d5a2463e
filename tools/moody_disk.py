"""A disk with moods, for `tools.disk_storm`: slow throughout, and now and then silent for a while.

In a module of its own because the recorder's process imports it by name.
"""

from __future__ import annotations

import os
import random
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acquire.store.files import Disk, ShardFile

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


@dataclass(frozen=True)
class MoodyDisk(Disk):
    """Takes ``bytes_per_s`` of lines, and naps before a ``share`` of its operations.

    A nap lasts up to ``longest_s``, mostly much less.
    """

    bytes_per_s: float
    share: float
    longest_s: float

    def nap(self) -> None:
        chance = random.Random(time.monotonic_ns() ^ os.getpid())
        if chance.random() < self.share:
            time.sleep(self.longest_s * chance.random() ** 3)

    def create(self, path: Path, *, direct: bool) -> ShardFile:
        self.nap()
        return MoodyFile(path, direct=direct, disk=self)

    def make_directory(self, path: Path, *, parents: bool = False) -> None:
        self.nap()
        super().make_directory(path, parents=parents)

    def rename(self, source: Path, target: Path) -> None:
        self.nap()
        super().rename(source, target)

    def sync_tree(self, path: Path) -> None:
        self.nap()
        super().sync_tree(path)

    def remove(self, path: Path) -> None:
        self.nap()
        super().remove(path)


class MoodyFile(ShardFile):
    """A file on it."""

    def __init__(self, path: Path, *, direct: bool, disk: MoodyDisk) -> None:
        super().__init__(path, direct=direct)
        self._disk = disk

    def write_pages(self, parts: Sequence[Any], offset: int) -> None:
        time.sleep(sum(memoryview(part).nbytes for part in parts) / self._disk.bytes_per_s)
        self._disk.nap()
        super().write_pages(parts, offset)

    def sync(self) -> None:
        self._disk.nap()
        super().sync()
