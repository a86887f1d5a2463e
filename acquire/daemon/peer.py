"""The client's connection to the daemon: nothing is sent before the listening process is identified.

In /tmp another user may have been faster, and listen in the daemon's place. The owners of directory and
socket are checked, and then, on the connection itself, the user of the process behind it (SO_PEERCRED).
"""

from __future__ import annotations

import os
import socket
import stat
import struct
import time
from typing import TYPE_CHECKING

from acquire.errors import NoDaemonError

if TYPE_CHECKING:
    from pathlib import Path

ELSEWHERE = "another place: --socket PATH, or XDG_RUNTIME_DIR with a directory of your own"
_AGAIN_S = 0.02


def connect(path: Path, timeout_s: float) -> socket.socket:
    """Return a connection to the daemon of this user.

    Raises NoDaemonError if none listens within the time, or a process of another user does.
    """
    deadline = time.monotonic() + timeout_s
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        _check_owner(path)
        connection.settimeout(timeout_s)
        while True:
            try:
                connection.connect(str(path))
                break
            # The queue of waiting connections is full: the daemon is busy. A Unix socket with a timeout does
            # not wait for its place in the queue, as one of TCP does.
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_AGAIN_S)
        _check_peer(connection, path)
    except OSError as error:
        connection.close()
        if path.exists() and not path.is_socket():
            kind = "directory" if path.is_dir() else "file"
            raise NoDaemonError(
                f"no daemon listens on {path}, which is a {kind} and not a socket",
                hint="the path of the daemon's control socket, which `acquire config check RIG` shows",
            ) from error
        raise NoDaemonError(
            f"no daemon listens on {path} ({error.strerror or error})",
            hint=f"acquire serve --config rig-demo --socket {path}",
        ) from error
    except BaseException:
        connection.close()
        raise
    return connection


def _check_owner(path: Path) -> None:
    """Check that only this user or root can have created the socket, or can replace it."""
    directory = path.parent.stat()
    # In a sticky directory, such as /tmp, others cannot replace a socket that is not theirs.
    others_write = directory.st_mode & 0o022 and not directory.st_mode & stat.S_ISVTX
    for owner in (directory.st_uid, path.stat().st_uid):
        if owner not in (0, os.geteuid()):
            raise _impostor(path, f"belongs to user {owner}")
    if others_write:
        raise _impostor(path, "lies in a directory that others can write to")


def _check_peer(connection: socket.socket, path: Path) -> None:
    form = "=3i"
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize(form))
    process, user, _ = struct.unpack(form, credentials)
    if user != os.geteuid():
        raise _impostor(path, f"is listened on by process {process} of user {user}")


def _impostor(path: Path, what: str) -> NoDaemonError:
    return NoDaemonError(
        f"control socket {path} {what}, and is not trusted by user {os.geteuid()}: nothing was sent",
        hint=ELSEWHERE,
    )
