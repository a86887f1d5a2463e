"""Atomic writes below a local directory: a process killed in between leaves either the old or the new bytes.

A file is prepared under the name `files.SCRATCH` in the same directory, forced to the medium, and renamed.
"""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING

from acquire.reading import open_regular
from acquire.store.files import DISK, SCRATCH, Publisher

if TYPE_CHECKING:
    from pathlib import Path


def put_bytes(file: Path, data: bytes) -> None:
    """Replace ``file`` by ``data``. Raises OSError."""
    Publisher(file.with_name(SCRATCH)).replace(file, data, durable=True)


def put_copy(file: Path, source: Path) -> None:
    """Replace ``file`` by the bytes of ``source``, a regular file. Raises OSError."""
    scratch = file.with_name(SCRATCH)
    DISK.remove(scratch)  # what a killed copy has left
    with os.fdopen(open_regular(source, follow=False), "rb") as original, scratch.open("xb") as copy:
        shutil.copyfileobj(original, copy, 2**22)
        copy.flush()
        os.fsync(copy.fileno())
    DISK.rename(scratch, file)
    DISK.sync_directory(file.parent)
