"""The configurations that come with the program."""

from __future__ import annotations

from pathlib import Path


def builtin_directory() -> Path:
    """Where they are: in an installed package, or beside it in a checkout."""
    package = Path(__file__).parent.parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def builtin_names(kind: str = "") -> list[str]:
    """Their names in order; of one kind (rig, scene, plan), or of all."""
    return sorted(path.stem for path in builtin_directory().glob(f"{kind}*.toml"))
