"""NDTiff (ndstorage): one data set, a block is an image."""

import sys
from collections import Counter
from pathlib import Path

import numpy as np
from ndstorage import NDTiffDataset
from stream import measure


class NdTiff:
    def __init__(self, directory: Path) -> None:
        self._data = NDTiffDataset(str(directory), name="r", summary_metadata={}, writable=True)
        self._count: Counter = Counter()

    def append(self, arm: str, block: np.ndarray) -> None:
        self._data.put_image({"arm": arm, "time": self._count[arm]}, block, {})
        self._count[arm] += 1

    def close(self) -> None:
        self._data.finish()
        self._data.close()


measure(NdTiff(Path(sys.argv[1])), Path(sys.argv[1]), int(sys.argv[2]))
