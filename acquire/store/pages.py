"""Memory and files in whole pages, as direct I/O wants them: aligned, allocated once, touched before use."""

from __future__ import annotations

import mmap
import os
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

PAGE = 4096
"""Bytes; alignment of addresses, offsets and lengths that every disk's direct I/O accepts."""


def page_up(size: int) -> int:
    """``size`` rounded up to whole pages."""
    return -(-size // PAGE) * PAGE


def aligned_bytes(size: int) -> NDArray[np.uint8]:
    """At least ``size`` bytes of zeros from a page's beginning on, in whole pages.

    They are written once here: the first touch of a page costs more than all later ones together.
    """
    memory = np.frombuffer(mmap.mmap(-1, max(PAGE, page_up(size))), np.uint8)
    memory.fill(0)
    return memory


def is_aligned(array: NDArray[Any]) -> bool:
    """The array's memory begins with a page."""
    return int(array.ctypes.data) % PAGE == 0


def open_direct(path: Path) -> int:
    """A descriptor that writes ``path`` past the page cache; -1 where the file system has no such thing."""
    try:
        return os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_DIRECT)
    except OSError:
        return -1
