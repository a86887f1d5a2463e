"""The daemon's status as plain JSON, without the models: for a command that is typed again and again.

The models take longer to import than the daemon takes to answer. That no daemon listens is reported as
quickly. All other cases are left to `acquire.client.Client`, which waits for a daemon that is starting, and
explains the errors of one that refuses.
"""

from __future__ import annotations

import http.client
import json
from typing import TYPE_CHECKING, Any

from acquire.daemon.peer import connect
from acquire.daemon.starting import is_one_starting
from acquire.errors import NoDaemonError
from acquire.place import default_socket

if TYPE_CHECKING:
    import socket
    from pathlib import Path

CONNECT_TIMEOUT_S = 5.0
NO_ANSWER = (OSError, http.client.HTTPException, LookupError, TypeError, ValueError)
"""Exceptions of `status_document`, and of showing a document of another version."""


def status_document(place: Path | None) -> dict[str, Any]:
    """Return the status of the daemon on a Unix socket (None: the default one), as JSON.

    Raises NoDaemonError if none listens and none is starting, otherwise one of `NO_ANSWER`.
    """
    place = place or default_socket()
    connection = _Connection("acquire", timeout=CONNECT_TIMEOUT_S)
    try:
        connection.sock = connect(place, CONNECT_TIMEOUT_S)
    except NoDaemonError:
        if is_one_starting(place):
            raise ConnectionRefusedError("a daemon is starting") from None
        connection.sock = connect(place, CONNECT_TIMEOUT_S)  # a daemon may have begun to listen in between
    try:
        # Each call has its own connection, of which the daemon keeps only a few open.
        connection.request("GET", "/status", headers={"Connection": "close"})
        answer = connection.getresponse()
        if answer.status != http.HTTPStatus.OK:
            raise ValueError(f"the daemon answered with HTTP {answer.status}")
        document = json.loads(answer.read())
    finally:
        connection.close()
    if not isinstance(document, dict):
        raise TypeError("the status is not an object")
    return document


class _Connection(http.client.HTTPConnection):
    """An HTTP connection over a socket that is connected already."""

    sock: socket.socket
