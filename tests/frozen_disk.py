"""A disk of its own that the kernel stops and lets go on: ext4 in a file, mounted, frozen and thawed."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

SIZE_BYTES = 2**28


@dataclass
class FreezableDisk:
    """A mounted file system; its writers wait while it is frozen."""

    path: Path
    is_frozen: bool = False

    def freeze(self) -> None:
        _run("fsfreeze", "--freeze", self.path)
        self.is_frozen = True

    def thaw(self) -> None:
        if self.is_frozen:
            _run("fsfreeze", "--unfreeze", self.path)
            self.is_frozen = False


@contextmanager
def mounted(home: Path) -> Iterator[FreezableDisk]:
    """A new disk below ``home``. Raises OSError or CalledProcessError where that is not allowed."""
    if os.geteuid() != 0:
        raise PermissionError("only root may mount a file system")
    image, place = home / "disk.img", home / "disk"
    place.mkdir()
    with image.open("wb") as file:
        file.truncate(SIZE_BYTES)
    _run("mkfs.ext4", "-q", image)
    _run("mount", "-o", "loop", image, place)
    disk = FreezableDisk(place)
    try:
        yield disk
    finally:
        disk.thaw()
        _run("umount", "--lazy", place)
        image.unlink()


def can_freeze() -> bool:
    with tempfile.TemporaryDirectory() as home:
        try:
            with mounted(Path(home)) as disk:
                disk.freeze()
                disk.thaw()
        except (OSError, subprocess.CalledProcessError):
            return False
        return True


def _run(*command: object) -> None:
    subprocess.run([str(word) for word in command], check=True, capture_output=True)
