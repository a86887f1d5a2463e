"""Memory and files in whole pages, as direct I/O wants them: aligned, allocated once, touched before use."""

from __future__ import annotations

import mmap
import os
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

PAGE = 4096
"""Bytes; alignment of addresses, offsets and lengths that every disk's direct I/O accepts."""


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Options of glibc's mallopt."""
KEPT_BYTES = 2**25
"""Pieces up to this size are kept: the most that glibc allows."""


def page_up(size: int) -> int:
    """``size`` rounded up to whole pages."""
    return -(-size // PAGE) * PAGE


def aligned_bytes(size: int) -> NDArray[np.uint8]:
    """At least ``size`` bytes of zeros from a page's beginning on, in whole pages.

    They are written once here: the first touch of a page costs more than all later ones together.
    """
    import numpy as np  # for those who write: lists of recordings need files and pages, too

    memory = np.frombuffer(mmap.mmap(-1, max(PAGE, page_up(size))), np.uint8)
    memory.fill(0)
    return memory


@cache
def keep_freed_memory() -> bool:
    """Let the C library keep what it is given back, for the rest of this process; False where it cannot.

    Each packed chunk is some MB that are allocated anew: taken from the system and returned every time, their
    first touch costs a third of the packing.
    """
    import ctypes  # as numpy above: for those who write

    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt"):  # not glibc
        return False
    return all(library.mallopt(option, KEPT_BYTES) for option in (M_MMAP_THRESHOLD, M_TRIM_THRESHOLD))


def is_aligned(array: NDArray[Any]) -> bool:
    """The array's memory begins with a page."""
    return int(array.__array_interface__["data"][0]) % PAGE == 0


def open_direct(path: Path, *, follow: bool = False) -> int:
    """A descriptor that writes ``path`` past the page cache; -1 where the file system has no such thing, or
    where ``path`` is a link that is not to be followed.
    """
    flags = os.O_WRONLY | os.O_CLOEXEC | os.O_DIRECT
    try:
        return os.open(path, flags if follow else flags | os.O_NOFOLLOW)
    except OSError:
        return -1
