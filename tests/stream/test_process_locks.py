"""What libraries make in a run's processes leaves no name behind, however the processes end."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np

from acquire.processes.worker import Mailbox, Worker

SHARED = Path("/dev/shm")


def pack(mailbox: Mailbox) -> None:
    """Use the library whose lock it is; how many locks this process has, and the names of those with one."""
    from numcodecs import blosc

    blosc.compress(np.zeros(1000, np.uint8), b"lz4", 1)
    blosc.get_mutex()
    maps = Path(f"/proc/{os.getpid()}/maps").read_text(encoding="utf-8").splitlines()
    inodes = {int(line.split()[4]) for line in maps if "/dev/shm/sem." in line}
    named = [entry.name for entry in os.scandir(SHARED) if entry.inode() in inodes]
    mailbox.post((len(inodes), named))


def test_locks_of_libraries_have_no_name() -> None:
    worker = Worker("packer", pack)
    try:
        locks, named = worker.expect(tuple, time.monotonic() + 60)
    finally:
        worker.end(time.monotonic() + 60)
    assert (locks, named) == (1, [])
