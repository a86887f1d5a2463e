"""acquire-zarr: one stream with an array per arm, chunks of a block, shards of 64."""

import sys
from pathlib import Path

import acquire_zarr
import numpy as np
from acquire_zarr import ArraySettings, Dimension, DimensionType, StreamSettings
from stream import ARMS, LINES, PIXELS, measure

SHARD_CHUNKS = 64


class AcquireZarr:
    def __init__(self, directory: Path) -> None:
        arrays = [
            ArraySettings(output_key=arm, dimensions=_dimensions(), data_type=acquire_zarr.DataType.UINT8)
            for arm in ARMS
        ]
        self._stream = acquire_zarr.ZarrStream(
            StreamSettings(store_path=str(directory / "r.zarr"), arrays=arrays)
        )

    def append(self, arm: str, block: np.ndarray) -> None:
        self._stream.append(block, arm)

    def close(self) -> None:
        self._stream.close()


def _dimensions() -> list[Dimension]:
    """A block is a frame; line and pixel are one chunk each."""
    sizes = (("t", DimensionType.TIME, 0, 1, SHARD_CHUNKS), ("y", DimensionType.SPACE, LINES, LINES, 1))
    return [
        Dimension(name=name, kind=kind, array_size_px=size, chunk_size_px=chunk, shard_size_chunks=shard)
        for name, kind, size, chunk, shard in (*sizes, ("x", DimensionType.SPACE, PIXELS, PIXELS, 1))
    ]


measure(AcquireZarr(Path(sys.argv[1])), Path(sys.argv[1]), int(sys.argv[2]))
