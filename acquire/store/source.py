"""Sources of recordings: keys and bytes below one place, on a local disk or remote."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from acquire.reading import open_regular, path_of, read_regular
from acquire.store.files import tree_bytes
from acquire.store.remote import RemoteSource, is_url

if TYPE_CHECKING:
    from zarr.abc.store import Store


class Source(Protocol):
    """Bytes by key, such as ``a/lines/c/0/0``. Methods raise OSError; FileNotFoundError for a missing key."""

    def __str__(self) -> str:
        """Return the place's name for the user."""

    def read(self, key: str) -> bytes:
        """Return all bytes of a key."""

    def read_range(self, key: str, start: int, size: int) -> bytes:
        """Return bytes ``start .. start + size - 1`` of a key, fewer if it ends earlier."""

    def expect(self, key: str, start: int, size: int) -> None:
        """Announce that these bytes will be read soon: a hint, which may start fetching them."""

    def size(self, key: str) -> int:
        """Return the size of a key in bytes."""

    def names(self, key: str) -> list[str]:
        """Return the names directly below ``key``; none if there is nothing."""

    def exists(self) -> bool:
        """Return whether there is anything at this place."""

    def total_bytes(self) -> int:
        """Return the bytes of all keys."""

    def beside(self, name: str) -> Source:
        """Return the place ``name`` in the same directory."""

    def zarr_store(self) -> Path | Store:
        """Return the same place for zarr-python."""


class LocalSource:
    """A directory."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._root = str(path)

    def __str__(self) -> str:
        return self._root

    def read(self, key: str) -> bytes:
        """Return all bytes of a file. Raises OddFileError for a pipe or a device in its place."""
        return read_regular(f"{self._root}/{key}")

    def read_range(self, key: str, start: int, size: int) -> bytes:
        """Return a part of a file, which is opened for it: a recording has more files than descriptors."""
        fd = open_regular(f"{self._root}/{key}")
        try:
            return os.pread(fd, size, start)
        finally:
            os.close(fd)

    def expect(self, key: str, start: int, size: int) -> None:
        """Advise the kernel to read the bytes ahead."""
        fd = open_regular(f"{self._root}/{key}")
        try:
            os.posix_fadvise(fd, start, size, os.POSIX_FADV_WILLNEED)
        finally:
            os.close(fd)

    def size(self, key: str) -> int:
        """Return the size of a file. Raises FileNotFoundError."""
        return os.stat(f"{self._root}/{key}").st_size  # noqa: PTH116 - for every file of a list of recordings

    def names(self, key: str) -> list[str]:
        """Return the names below ``key``, in no particular order."""
        try:
            return os.listdir(f"{self._root}/{key}")  # noqa: PTH208 - names only, without a Path for each
        except (FileNotFoundError, NotADirectoryError):
            return []

    def exists(self) -> bool:
        """Return whether the directory, or anything else, is there."""
        return self.path.exists()

    def total_bytes(self) -> int:
        """Return the bytes of all files."""
        return tree_bytes(self.path)

    def beside(self, name: str) -> LocalSource:
        """Return the directory of that name next to this one."""
        return LocalSource(self.path.with_name(name))

    def zarr_store(self) -> Path | Any:
        """Return the path, which zarr-python opens itself."""
        return self.path


def source_of(place: Path | str) -> Source:
    """Return the source for a path or a URL. Raises UsageError for an invalid URL, PlaceError for neither."""
    if not is_url(place):
        return LocalSource(path_of(place))
    remote = RemoteSource(str(place))
    # A file:// URL is a path: read directly, it is faster, and a pipe in it is refused.
    return remote if remote.path is None else LocalSource(remote.path)
