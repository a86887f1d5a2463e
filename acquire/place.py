"""Where the daemon listens unless a rig or a command says otherwise; apart, so that clients import little."""

from __future__ import annotations

import os
from pathlib import Path


def default_socket() -> Path:
    """The control socket where none is configured: in the user's runtime directory, else in one in /tmp."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or f"/tmp/acquire-{os.geteuid()}"  # noqa: S108
    return Path(runtime) / "acquire.sock"
