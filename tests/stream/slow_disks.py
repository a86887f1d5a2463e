"""Disks for the real recorder process that are slow, or fail after some bytes. Picklable."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acquire.store.files import Disk, ShardFile


@dataclass(frozen=True)
class SlowDisk(Disk):
    """Takes so many bytes of lines per second."""

    bytes_per_s: float

    def create(self, path: Path, *, direct: bool) -> ShardFile:
        return SlowFile(path, direct=direct, bytes_per_s=self.bytes_per_s)


class SlowFile(ShardFile):
    def __init__(self, path: Path, *, direct: bool, bytes_per_s: float) -> None:
        super().__init__(path, direct=direct)
        self._bytes_per_s = bytes_per_s

    def write_pages(self, parts: Sequence[Any], offset: int) -> None:
        time.sleep(sum(memoryview(part).nbytes for part in parts) / self._bytes_per_s)
        super().write_pages(parts, offset)


@dataclass(frozen=True)
class FailingDisk(Disk):
    """Refuses with ``number`` once a file of lines would pass so many bytes; ``wholly``: all after it.

    ``bytes_per_s``: of lines, that it takes before.
    """

    number: int
    after_bytes: int
    marker: Path
    """Exists once it has failed: the writer's process knows of it by nothing else."""
    wholly: bool = False
    bytes_per_s: float = math.inf

    def create(self, path: Path, *, direct: bool) -> ShardFile:
        self._refuse()
        return FailingFile(path, direct=direct, disk=self)

    def write_file(self, path: Path, data: Any, *, durable: bool) -> None:
        self._refuse()
        super().write_file(path, data, durable=durable)

    def rename(self, source: Path, target: Path) -> None:
        self._refuse()
        super().rename(source, target)

    def fail(self) -> None:
        self.marker.touch()
        raise OSError(self.number, os.strerror(self.number))

    def _refuse(self) -> None:
        if self.wholly and self.marker.exists():
            self.fail()


class FailingFile(ShardFile):
    def __init__(self, path: Path, *, direct: bool, disk: FailingDisk) -> None:
        super().__init__(path, direct=direct)
        self._disk = disk

    def write_pages(self, parts: Sequence[Any], offset: int) -> None:
        size = sum(memoryview(part).nbytes for part in parts)
        time.sleep(size / self._disk.bytes_per_s)
        if offset + size > self._disk.after_bytes:
            self._disk.fail()
        super().write_pages(parts, offset)


@dataclass(frozen=True)
class PausingDisk(Disk):
    """Does not answer what is asked ``at`` some of its operations, as long as the file ``gate`` exists."""

    gate: Path
    at: str

    @property
    def held(self) -> Path:
        """Exists once something has been held up: who waits is in another process."""
        return self.gate.with_name("held")

    def create(self, path: Path, *, direct: bool) -> ShardFile:
        self.pause("create")
        return PausingFile(path, direct=direct, disk=self)

    def make_directory(self, path: Path, *, parents: bool = False) -> None:
        self.pause("make")
        super().make_directory(path, parents=parents)

    def rename(self, source: Path, target: Path) -> None:
        self.pause("commit")
        super().rename(source, target)

    def sync_tree(self, path: Path) -> None:
        self.pause("seal")
        super().sync_tree(path)

    def remove(self, path: Path) -> None:
        self.pause("delete")
        super().remove(path)

    def pause(self, operation: str) -> None:
        while operation == self.at and self.gate.exists():
            self.held.touch()
            time.sleep(0.005)


class PausingFile(ShardFile):
    def __init__(self, path: Path, *, direct: bool, disk: PausingDisk) -> None:
        super().__init__(path, direct=direct)
        self._disk = disk

    def write_pages(self, parts: Sequence[Any], offset: int) -> None:
        self._disk.pause("pages")
        super().write_pages(parts, offset)

    def sync(self) -> None:
        self._disk.pause("sync")
        super().sync()
