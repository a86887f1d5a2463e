"""zarr-python: one array per arm that grows by whole chunks, crc32c, no test for empty chunks (faster)."""

import sys
from pathlib import Path

import numpy as np
import zarr
from stream import ARMS, LINES, PIXELS, measure
from zarr.codecs import BytesCodec, Crc32cCodec


class ZarrPython:
    def __init__(self, directory: Path) -> None:
        group = zarr.create_group(directory / "r.zarr")
        self._arrays = {
            arm: group.create_array(
                arm, shape=(0, PIXELS), chunks=(LINES, PIXELS), dtype="uint8",
                serializer=BytesCodec(), compressors=[Crc32cCodec()], config={"write_empty_chunks": True},
            )
            for arm in ARMS
        }  # fmt: skip

    def append(self, arm: str, block: np.ndarray) -> None:
        array = self._arrays[arm]
        rows = array.shape[0]
        array.resize((rows + LINES, PIXELS))
        array[rows:] = block

    def close(self) -> None:
        """Nothing is buffered."""


measure(ZarrPython(Path(sys.argv[1])), Path(sys.argv[1]), int(sys.argv[2]))
