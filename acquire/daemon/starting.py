"""Detects a daemon of this user that is starting: its interpreter runs, and its socket is still to come."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from acquire.cores import process_age_s

LONGEST_S = 60.0
"""A daemon older than this is not starting any more."""
ACCEPTS = "00010000"
"""Flags in ``/proc/net/unix`` of a listening socket."""


def is_one_starting(socket: Path) -> bool:
    """Return whether an ``acquire serve`` has just been started that may listen on ``socket``."""
    return any(may_listen(process, socket) for process in Path("/proc").iterdir() if process.name.isdigit())


def may_listen(process: Path, socket: Path) -> bool:
    """Return whether the process, in ``/proc``, is a starting daemon of this user, maybe for this socket."""
    try:
        if process.stat().st_uid != os.geteuid():
            return False
        words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
        if "serve" not in words or not any(Path(word).name == "acquire" for word in words):
            return False
        given = _socket_of(words, (process / "environ").read_bytes())
        # By the name alone: a relative path is relative to that process's directory. A wrong guess costs a
        # wait.
        may_be = given is None or Path(given).name == socket.name
        return may_be and process_age_s(process) < LONGEST_S and not _listens(process)
    except (OSError, ValueError):
        return False  # it has ended in the meantime


def _socket_of(words: list[str], environment: bytes) -> str | None:
    """Return the socket given to the process by option or environment; None: by its configuration."""
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word == "--socket":
            return following
        if word.startswith("--socket="):
            return word.removeprefix("--socket=")
    for entry in environment.split(b"\0"):
        if entry.startswith(b"ACQUIRE_SOCKET="):
            return os.fsdecode(entry.removeprefix(b"ACQUIRE_SOCKET="))
    return None


def _listens(process: Path) -> bool:
    """Return whether the process listens on a Unix socket already, which must be another one."""
    # The columns of proc(5): flags in the fourth, the inode in the seventh, then the path. A socket without a
    # path is none that a client could mean.
    rows = [row.split() for row in (process / "net" / "unix").read_text(errors="replace").splitlines()[1:]]
    accepting = {f"socket:[{row[6]}]" for row in rows if row[3] == ACCEPTS and len(row) > 7}
    for descriptor in (process / "fd").iterdir():
        with suppress(FileNotFoundError):  # a starting process opens and closes files all the time
            if str(descriptor.readlink()) in accepting:
                return True
    return False
