"""A disk that the kernel makes slow for chosen processes: a control group with a limit on direct writes."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Self

V1, V2 = Path("/sys/fs/cgroup/blkio"), Path("/sys/fs/cgroup")


class Throttle:
    """So many bytes per second to the device of ``place``, for the processes it is told to take.

    Raises OSError where this is not allowed, or the device knows no limit.
    """

    def __init__(self, place: Path, bytes_per_s: float) -> None:
        device = place.stat().st_dev
        name = f"{os.major(device)}:{os.minor(device)}"
        self._root = V1 if V1.is_dir() else V2
        self._group = self._root / f"acquire-test-{os.getpid()}"
        self._group.mkdir()
        self._taken: list[int] = []
        try:
            if self._root == V1:
                (self._group / "blkio.throttle.write_bps_device").write_text(f"{name} {bytes_per_s:.0f}")
            else:
                (self._group / "io.max").write_text(f"{name} wbps={bytes_per_s:.0f}")
        except OSError:
            self._group.rmdir()
            raise

    def take(self, pid: int) -> None:
        (self._group / "cgroup.procs").write_text(str(pid))
        self._taken.append(pid)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for pid in self._taken:
            with contextlib.suppress(ProcessLookupError):  # it has ended
                (self._root / "cgroup.procs").write_text(str(pid))
        self._group.rmdir()


def can_throttle(place: Path) -> bool:
    try:
        with Throttle(place, 2**20):
            return True
    except OSError:
        return False
