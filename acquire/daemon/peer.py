"""The client's way to the daemon: nothing is sent before the system has said whose process listens.

In /tmp another user may have been quicker and listen in the daemon's place. Owners of directory and socket
are looked at, and then, on the connection itself, the user of the process behind it (SO_PEERCRED).
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
    """A connection to the daemon of this user, and to nobody else.

    Raises NoDaemonError where nobody listens within the time, or somebody else does.
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
            except BlockingIOError:  # as many wait as can: the daemon is busy
                if time.monotonic() > deadline:
                    raise
                time.sleep(_AGAIN_S)
        _check_peer(connection, path)
    except OSError as error:
        connection.close()
        raise NoDaemonError(
            f"no daemon listens on {path} ({error.strerror or error})",
            hint=f"acquire serve --config rig-demo --socket {path}",
        ) from error
    except BaseException:
        connection.close()
        raise
    return connection


def _check_owner(path: Path) -> None:
    """Whoever may replace the socket, or made it, is this user or root."""
    directory = path.parent.stat()
    others_write = directory.st_mode & 0o022 and not directory.st_mode & stat.S_ISVTX
    for owner in (directory.st_uid, path.stat().st_uid):
        if owner not in (0, os.geteuid()):
            raise _impostor(path, f"belongs to user {owner}")
    if others_write:
        raise _impostor(path, "lies in a directory that others can write to")


def _check_peer(connection: socket.socket, path: Path) -> None:
    form = "=3i"
    told = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize(form))
    process, user, _ = struct.unpack(form, told)
    if user != os.geteuid():
        raise _impostor(path, f"is listened on by process {process} of user {user}")


def _impostor(path: Path, what: str) -> NoDaemonError:
    return NoDaemonError(
        f"control socket {path} {what}, not to be trusted by user {os.geteuid()}: nothing was sent",
        hint=ELSEWHERE,
    )
