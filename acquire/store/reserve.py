"""Room that is kept for the end of a recording: its metadata must find some on a disk that is full."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.store.files import Disk

END_BYTES = 2**21
"""Bytes for the metadata of the end: more than tables (`table.TEXT_BYTES`) and a usual root take."""
USUAL_ROOT_BYTES = 2**17
"""Bytes of them for the root; for a larger one, more are reserved."""


class EndReserve:
    """A file of the size of that metadata; `release` gives its room to them."""

    def __init__(self, disk: Disk, path: Path) -> None:
        self._disk = disk
        self._path = path
        self._bytes = END_BYTES

    def create(self) -> None:
        """Reserve the room for a recording that begins. Raises OSError if the disk has none."""
        self._disk.reserve(self._path, self._bytes)

    def fit(self, root_bytes: int) -> None:
        """Reserve more for a root that has grown: it lists holds, and what was dropped between them."""
        # Root and copy are each written before they replace the old one.
        if 2 * root_bytes <= self._bytes - END_BYTES + USUAL_ROOT_BYTES:
            return
        more = END_BYTES + 4 * root_bytes  # enough until it has doubled
        with suppress(OSError):  # what is reserved stays; the disk is about to end the recording
            self._disk.reserve_more(self._path, more)
            self._bytes = more

    def release(self) -> None:
        """Remove the file: what is written next has its room. Idempotent."""
        self._disk.remove(self._path)
