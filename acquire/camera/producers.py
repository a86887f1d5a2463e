"""Finds GenTL producers (.cti files), as configured or in the directories of GENICAM_GENTL64_PATH."""

from __future__ import annotations

import os
from pathlib import Path

from acquire.errors import CameraError

PATH = "GENICAM_GENTL64_PATH"


def find_producers(cti: str = "") -> list[Path]:
    """Return the producer ``cti``, or all in the environment's directories.

    Raises CameraError if none exists.
    """
    if cti:
        path = Path(cti).expanduser()
        if not path.is_file():
            raise CameraError(f"GenTL producer {cti}: there is no such file", hint="the path of a .cti file")
        return [path.absolute()]
    # harvesters does not read the variable.
    directories = [Path(entry) for entry in os.environ.get(PATH, "").split(os.pathsep) if entry]
    found = [path for directory in directories for path in sorted(directory.glob("*.cti"))]
    if not found:
        raise CameraError(
            "there is no GenTL producer",
            possible=f".cti files in the directories of {PATH}, which the maker of a frame grabber installs",
            hint=f"set cti in the camera's table, or {PATH} in the environment",
        )
    return found
