"""Delivery of a Zarr group that is prepared in private and appears complete, on a disk or at a URL.

::

    path   .NAME.partial beside it ─▶ forced to the medium ─▶ renamed
    URL    a temporary directory   ─▶ its arrays are put ─▶ its root metadata, as the last
    file   .NAME.partial beside it ─▶ forced to the medium ─▶ linked (`whole_file`)

Readers open a group's ``zarr.json`` first: until it exists, there is no group. The remains of a failed upload
are therefore no group, and are replaced by the next attempt.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from acquire.errors import UsageError
from acquire.store.files import DISK, check_new_path
from acquire.store.refusals import refused
from acquire.store.remote import RemoteSource, is_url

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = "zarr.json"
NO_HARD_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS)
"""Errors of `os.link` on a file system without hard links, as memory cards and some network disks have."""


class Delivery(Protocol):
    """A group being prepared in ``partial``, until it is delivered or given up."""

    partial: Path

    def deliver(self) -> None:
        """Make it appear at its place. Raises UsageError if that is taken by now, StoreError if it fails."""

    def clear(self) -> None:
        """Remove the preparations; a delivered group stays."""


@contextmanager
def whole_file(path: Path, *, keep_suffix: bool = False) -> Iterator[Path]:
    """Yield an empty file to be filled, which appears at ``path`` when the block ends without an error.

    With ``keep_suffix`` it has the suffix of ``path``, which tells some libraries the format.

    Raises UsageError if ``path`` was created in the meantime, which is left alone, and the errors of
    `refused` if the disk refuses; then nothing is left behind.
    """
    part = _partial(path)
    if keep_suffix:
        part = part.with_name(part.name + path.suffix)
    with refused(path, "written"):
        part.open("xb").close()
    try:
        yield part
        with refused(path, "written"):
            with part.open("rb+") as file:
                os.fsync(file.fileno())
            try:
                os.link(part, path)  # refuses where a rename would replace
            except FileExistsError as error:
                raise UsageError(
                    f"{path} was created by another program in the meantime", hint="another name"
                ) from error
            except OSError as error:
                if error.errno not in NO_HARD_LINKS:
                    raise
                # The next best: what another program creates between these two lines would be replaced.
                check_new_path(path)
                part.rename(path)
    finally:
        part.unlink(missing_ok=True)


def _partial(path: Path) -> Path:
    """Return an unused name beside ``path``."""
    # Not made of the process number: in a container, each run may have the same one as a killed run whose
    # remains are still there.
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")


def delivery_to(place: Path | str) -> Delivery:
    """Begin a delivery. Raises UsageError if the place is taken, StoreError if a store does not answer."""
    return _FarDelivery(str(place)) if is_url(place) else _LocalDelivery(Path(place))


def check_new_place(place: Path | str) -> None:
    """Do as `check_new_file`, for a path or a URL."""
    if is_url(place):
        _check_free(RemoteSource(str(place)))
    else:
        check_new_file(Path(place))


def check_new_file(path: Path) -> None:
    """Do as `check_new_path`, and try it: create a file beside ``path``, and remove it.

    For outputs that are written only after minutes of work. Permissions do not tell everything: /proc refuses
    any new file, a disk may be full of files, and a name may be too long once `_partial` has extended it.
    """
    check_new_path(path)
    with refused(path, "written"):
        part = _partial(path)
        part.open("xb").close()
        part.unlink()


class _LocalDelivery:
    def __init__(self, path: Path) -> None:
        check_new_path(path)
        self._path = path
        self.partial = _partial(path)

    def deliver(self) -> None:
        with refused(self._path, "written"):
            # Contents before the name: after a power failure there is no video, rather than half of one.
            DISK.sync_tree(self.partial)
            check_new_path(self._path)  # once more, since `rename` would replace an empty directory
            self.partial.rename(self._path)
            DISK.sync_directory(self._path.parent)

    def clear(self) -> None:
        shutil.rmtree(self.partial, ignore_errors=True)


class _FarDelivery:
    def __init__(self, url: str) -> None:
        self._target = RemoteSource(url)
        _check_free(self._target)
        # A rest there must not make a group that was delivered a failure.
        self._directory = tempfile.TemporaryDirectory(prefix="acquire-", ignore_cleanup_errors=True)
        self.partial = Path(self._directory.name) / "group.zarr"

    def deliver(self) -> None:
        _check_free(self._target)  # once more: another program may have put something there since
        files = [file for file in self.partial.rglob("*") if file.is_file()]
        # Metadata of arrays first, by which `_check_free` recognises a failed upload; the root last.
        files.sort(key=lambda file: (file == self.partial / ROOT, file.name != ROOT))
        with refused(self._target, "written"):
            for file in files:
                key = file.relative_to(self.partial).as_posix()
                if self._target.has_directories:
                    self._target.make_directory_of(key)
                self._target.put_file(key, file)

    def clear(self) -> None:
        self._directory.cleanup()


def _check_free(target: RemoteSource) -> None:
    """Raise UsageError unless the target is empty, or holds arrays without a root: a failed upload."""
    with refused(target, "read"):
        there = target.sizes()
    if ROOT in there:
        raise UsageError(f"{target} exists already", hint="another name; nothing is ever overwritten")
    arrays = {key.partition("/")[0] for key in there if key.endswith(f"/{ROOT}")}
    foreign = sorted(key for key in there if key.partition("/")[0] not in arrays)
    if foreign:
        raise UsageError(f"{target} holds something else, such as {foreign[0]}", hint="another URL")
