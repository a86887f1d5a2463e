"""Where a recording is read from: named parts of bytes below one place, on a local disk or far away."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from acquire.reading import open_regular, read_regular
from acquire.store.files import tree_bytes
from acquire.store.remote import RemoteSource, is_url

if TYPE_CHECKING:
    from zarr.abc.store import Store


class Source(Protocol):
    """Bytes by key, as ``a/lines/c/0/0``. Methods raise OSError; FileNotFoundError for what is not there."""

    def __str__(self) -> str:
        """How the place is named to the user."""

    def read(self, key: str) -> bytes:
        """All bytes of one part."""

    def read_range(self, key: str, start: int, size: int) -> bytes:
        """Bytes ``start .. start + size - 1`` of one part, fewer where it ends earlier."""

    def expect(self, key: str, start: int, size: int) -> None:
        """These bytes will be read soon: a hint, which may begin to fetch them."""

    def size(self, key: str) -> int:
        """Bytes of one part."""

    def names(self, key: str) -> list[str]:
        """Names of what lies directly below ``key``; none where there is nothing."""

    def exists(self) -> bool:
        """There is something at this place."""

    def total_bytes(self) -> int:
        """Bytes of all parts."""

    def beside(self, name: str) -> Source:
        """The place ``name`` in the directory that holds this one."""

    def zarr_store(self) -> Path | Store:
        """The same place for zarr-python."""


class LocalSource:
    """A directory."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._root = str(path)

    def __str__(self) -> str:
        return self._root

    def read(self, key: str) -> bytes:
        return read_regular(f"{self._root}/{key}")

    def read_range(self, key: str, start: int, size: int) -> bytes:
        fd = open_regular(f"{self._root}/{key}")
        try:
            return os.pread(fd, size, start)
        finally:
            os.close(fd)

    def expect(self, key: str, start: int, size: int) -> None:
        fd = open_regular(f"{self._root}/{key}")
        try:
            os.posix_fadvise(fd, start, size, os.POSIX_FADV_WILLNEED)
        finally:
            os.close(fd)

    def size(self, key: str) -> int:
        return (self.path / key).stat().st_size

    def names(self, key: str) -> list[str]:
        try:
            return os.listdir(f"{self._root}/{key}")  # noqa: PTH208
        except (FileNotFoundError, NotADirectoryError):
            return []

    def exists(self) -> bool:
        return self.path.exists()

    def total_bytes(self) -> int:
        return tree_bytes(self.path)

    def beside(self, name: str) -> LocalSource:
        return LocalSource(self.path.with_name(name))

    def zarr_store(self) -> Path | Any:
        return self.path


def source_of(place: Path | str) -> Source:
    """The source for a path, or for a URL. Raises UsageError for a URL that cannot be one."""
    if not is_url(place):
        return LocalSource(Path(place))
    remote = RemoteSource(str(place))
    return remote if remote.path is None else LocalSource(remote.path)
