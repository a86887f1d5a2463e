"""Memory and files in whole pages, as direct I/O requires: aligned, allocated once, touched before use."""

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
"""Largest allocation that is kept: the limit of glibc."""


def page_up(size: int) -> int:
    """Return ``size`` rounded up to whole pages."""
    return -(-size // PAGE) * PAGE


def aligned_bytes(size: int) -> NDArray[np.uint8]:
    """Return at least ``size`` bytes of zeros in whole pages.

    They are written once here: the first touch of a page costs more than all later ones together.
    """
    import numpy as np  # here, since lists of recordings import this module, and do without numpy

    memory = np.frombuffer(mmap.mmap(-1, max(PAGE, page_up(size))), np.uint8)
    memory.fill(0)
    return memory


@cache
def keep_freed_memory() -> bool:
    """Have the C library keep freed memory for the rest of this process; return False if it cannot.

    Each packed chunk is a new allocation of some MB: if it were taken from the system and returned every
    time, the first touch of its pages would cost a third of the packing.
    """
    import ctypes  # here for the same reason as numpy above

    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt"):  # not glibc
        return False
    return all(library.mallopt(option, KEPT_BYTES) for option in (M_MMAP_THRESHOLD, M_TRIM_THRESHOLD))


def is_aligned(array: NDArray[Any]) -> bool:
    """Return whether the array's memory begins at a page boundary."""
    return int(array.__array_interface__["data"][0]) % PAGE == 0


def open_direct(path: Path, *, follow: bool = False) -> int:
    """Return a descriptor that writes ``path`` past the page cache.

    Return -1 if the file system cannot do that, or if ``path`` is a link that is not to be followed.
    """
    flags = os.O_WRONLY | os.O_CLOEXEC | os.O_DIRECT
    try:
        return os.open(path, flags if follow else flags | os.O_NOFOLLOW)
    except OSError:
        return -1
