"""Readiness and liveness for systemd (``Type=notify``): datagrams to the socket that it names, if any."""

from __future__ import annotations

import os
import socket


def notify(message: str) -> bool:
    """Send ``READY=1``, ``STOPPING=1``, ``WATCHDOG=1`` …; return whether it was sent.

    Errors are not raised: a notification that cannot be delivered must not end a measurement.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return False
    # "@" stands for the NUL byte with which an abstract address begins.
    to = address.replace("@", "\0", 1) if address[0] == "@" else address
    try:
        # Even the socket may be refused, with no descriptor left, which is no reason to be killed by systemd.
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
            sender.sendto(message.encode(), to)
    except OSError:
        return False
    return True
