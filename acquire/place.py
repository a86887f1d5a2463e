"""Places that are known without a configuration: the daemon's socket, the files that come with the program.

Apart from what reads them, so that clients and completion import little.
"""

from __future__ import annotations

import os
from pathlib import Path


def default_socket() -> Path:
    """The control socket where none is configured: in the user's runtime directory, else in one in /tmp."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or f"/tmp/acquire-{os.geteuid()}"  # noqa: S108
    return Path(runtime) / "acquire.sock"


def builtin_directory() -> Path:
    """Where the configurations are that come with the program: in an installed package, or beside it."""
    package = Path(__file__).parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def builtin_names(kind: str = "") -> list[str]:
    """Their names in order; of one kind (rig, scene, plan), or of all."""
    return sorted(path.stem for path in builtin_directory().glob(f"{kind}*.toml"))
