"""Paths that are known without a configuration: the daemon's socket, the files that come with the program.

They are apart from the code that reads them, so that clients and shell completion import little.
"""

from __future__ import annotations

import os
from pathlib import Path


def home() -> Path:
    """Return this user's home directory; one that does not exist for an account that has none."""
    try:
        return Path.home()
    except RuntimeError:  # as of a container's user, who is in no list of accounts
        return Path("/nonexistent")


def default_socket() -> Path:
    """Return the default control socket: in the user's runtime directory, else in one in /tmp."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or f"/tmp/acquire-{os.geteuid()}"  # noqa: S108
    return Path(runtime) / "acquire.sock"


def builtin_directory() -> Path:
    """Return the directory of the built-in configurations: in an installed package, or next to it."""
    package = Path(__file__).parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def builtin_names(kind: str = "") -> list[str]:
    """Return the names of the built-in configurations in order: of one kind (rig, scene, plan), or of all."""
    return sorted(path.stem for path in builtin_directory().glob(f"{kind}*.toml"))
