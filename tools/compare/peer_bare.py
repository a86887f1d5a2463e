"""No format: one file with O_DIRECT, the limit of the disk."""

import os
import sys
from pathlib import Path

import numpy as np
from stream import measure


class Bare:
    def __init__(self, directory: Path) -> None:
        self._fd = os.open(directory / "bare", os.O_WRONLY | os.O_CREAT | os.O_DIRECT)
        self._end = 0

    def append(self, arm: str, block: np.ndarray) -> None:  # noqa: ARG002 - one file for all
        self._end += os.pwrite(self._fd, block.data.cast("B"), self._end)

    def close(self) -> None:
        os.close(self._fd)


measure(Bare(Path(sys.argv[1])), Path(sys.argv[1]), int(sys.argv[2]))
