"""tensorstore: one zarr3 array per arm that grows by whole chunks, crc32c; four writes at a time."""

import sys
from collections import deque
from pathlib import Path

import numpy as np
import tensorstore
from stream import ARMS, LINES, PIXELS, measure

UNDER_WAY = 4


class TensorStore:
    def __init__(self, directory: Path) -> None:
        self._arrays = {arm: _create(directory / "r.zarr" / arm) for arm in ARMS}
        self._rows = dict.fromkeys(ARMS, 0)
        self._writing: deque = deque()

    def append(self, arm: str, block: np.ndarray) -> None:
        rows = self._rows[arm]
        self._rows[arm] = rows + LINES
        array = self._arrays[arm] = self._arrays[arm].resize(exclusive_max=[rows + LINES, PIXELS]).result()
        # Blocks do not change while they are written: no copy is needed.
        self._writing.append(
            array[rows : rows + LINES].write(block, can_reference_source_data_indefinitely=True)
        )
        if len(self._writing) > UNDER_WAY:
            self._writing.popleft().result()

    def close(self) -> None:
        while self._writing:
            self._writing.popleft().result()


def _create(path: Path) -> tensorstore.TensorStore:
    chunks = {"name": "regular", "configuration": {"chunk_shape": [LINES, PIXELS]}}
    metadata = {
        "shape": [0, PIXELS],
        "data_type": "uint8",
        "chunk_grid": chunks,
        "codecs": [{"name": "bytes"}, {"name": "crc32c"}],
    }
    spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{path}/"}, "metadata": metadata}
    return tensorstore.open(spec, create=True).result()


measure(TensorStore(Path(sys.argv[1])), Path(sys.argv[1]), int(sys.argv[2]))
