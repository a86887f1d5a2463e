"""Errors for the user when a disk or a remote store refuses an operation.

::

    no such path or bucket, no permission, no credentials   PlaceError, 2   another place or permissions
    the disk is full, the store or its network is away      StoreError, 5   later, or on another disk
    the medium cannot be read                               DataError, 6    a copy of the recording
"""

from __future__ import annotations

import errno
from contextlib import contextmanager
from typing import TYPE_CHECKING

from acquire.errors import DataError, PlaceError, StoreError
from acquire.reading import OddFileError
from acquire.store.remote import is_url

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.errors import AcquireError

# With EINVAL, by which FAT and network disks refuse some characters in a name.
NOT_A_PLACE = (
    errno.EACCES,
    errno.EEXIST,
    errno.EINVAL,
    errno.EISDIR,
    errno.ELOOP,
    errno.ENAMETOOLONG,
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EPERM,
    errno.EROFS,
)
"""Errors of a path, or of this user's permissions there; all other errors are the disk's."""

_DAMAGE = (
    errno.EBADMSG,
    errno.EILSEQ,
    errno.EIO,
    errno.EISDIR,
    errno.ELOOP,
    errno.ENODATA,
    errno.ENOENT,
    errno.ENOTDIR,
    errno.ENXIO,
    errno.EREMOTEIO,
    errno.EUCLEAN,
)

_PERMISSIONS = "its permissions for this user, or another path"
CURES = {
    errno.EACCES: _PERMISSIONS,
    errno.EDQUOT: "free space within this user's quota there, a larger quota, or another disk",
    errno.EFBIG: "a disk whose file system holds larger files",
    errno.ENAMETOOLONG: "a shorter name",
    errno.ENOSPC: "free space there, or another disk",
    errno.EPERM: _PERMISSIONS,
    errno.EROFS: "another disk, or mount this one for writing (the kernel's log says if errors ended that)",
}
"""What helps against an error of a disk that tells it."""

_RIGHTS = "the credentials in the environment (for S3: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION)"
_LOCAL = ("file://", "local://")
_NETWORK = "the network and the store's address (for S3: AWS_ENDPOINT, and AWS_ALLOW_HTTP=true for http://)"


def shows_damage(error: OSError) -> bool:
    """Return whether an error of reading shows that a file, or its medium, is damaged or gone.

    Any other may pass, such as no descriptor or memory left, no permission, a network that is away. It says
    nothing about the lines, which must not be flagged as missing for it.
    """
    return isinstance(error, FileNotFoundError | OddFileError) or error.errno in _DAMAGE


@contextmanager
def refused(place: object, doing: str, hint: str = "") -> Iterator[None]:
    """Turn an OSError of the block into an error for the user; see `refusal`."""
    try:
        yield
    except OSError as error:
        raise refusal(place, error, doing, hint) from error


def refusal(place: object, error: OSError, doing: str, hint: str = "") -> AcquireError:
    """Return the error for a place (path or URL) that cannot be read, written, copied: ``doing``.

    ``hint`` is added to the advice, which fits the error.
    """
    text = f"{place} cannot be {doing}: {error.strerror or error}"
    if is_url(str(place)) and not str(place).startswith(_LOCAL):
        kind: type[AcquireError] = StoreError
        advice = _NETWORK
        if isinstance(error, FileNotFoundError):
            kind, advice = PlaceError, "an existing bucket or directory"
        elif isinstance(error, PermissionError):
            kind, advice = PlaceError, _RIGHTS
        return kind(text, hint="; ".join(filter(None, (advice, hint))))
    if error.errno == errno.EIO and doing == "read":
        return DataError(text, hint="a copy of the recording, and the kernel's log for errors of the disk")
    place_kind = error.errno in NOT_A_PLACE
    usual = "another path" if place_kind else "the kernel's log for errors of the disk"
    advice = CURES.get(error.errno or 0, usual)
    return (PlaceError if place_kind else StoreError)(text, hint="; ".join(filter(None, (advice, hint))))
