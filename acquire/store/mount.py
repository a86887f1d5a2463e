"""Where the disk of a recording is mounted: without that disk it is a directory on the host's own.

Recordings below it would fill the host's disk, and be hidden once theirs is back.
"""

from __future__ import annotations

import os
from pathlib import Path

from acquire.errors import StoreError

NOT_MOUNTED = "its disk is not mounted on {} any more"
MOUNT_IT = "mount it again"


def mount_above(directory: Path) -> Path:
    """Return the point at which the directory's disk is mounted; for one that is missing, its parents'."""
    path = Path(os.path.realpath(directory))
    return next(above for above in (path, *path.parents) if above == above.parent or above.is_mount())


def refuse_unmounted(path: Path, mount: Path | None) -> None:
    """Raise StoreError if ``path`` is to be created on a disk that is not mounted on ``mount`` any more."""
    if mount is not None and not mount.is_mount():
        what = f"no recording can begin in {path.parent}: {NOT_MOUNTED.format(mount)}"
        raise StoreError(what, hint=MOUNT_IT)
