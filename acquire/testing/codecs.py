"""Tests that every codec must pass: extend `CodecContract` with a fixture ``codec``."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zarr

from acquire.plugins import CODECS as INSTALLED
from acquire.store.array_writer import ArrayWriter
from acquire.store.chunks import ChunkReader
from acquire.store.layout import line_array, line_columns, to_json
from acquire.store.plugin_codecs import as_plugin
from acquire.store.shape import CODECS, CRC_BYTES, ArrayShape, most_stored_bytes
from acquire.store.source import LocalSource

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.store.shape import Codec
    from acquire.store.variant import CodecVariant

SIZES = ((1, 1), (1, 5), (16, 1), (16, 64), (33, 7), (512, 640))
"""Lines and pixels of the chunks that are packed; the last ones are of a usual size."""
CHUNK_LINES = 16


class CodecContract:
    """Needs a fixture ``codec``: the model of an installed codec, with any options, not yet fitted."""

    def test_a_rig_file_finds_it_and_another_process_is_given_the_same(self, codec: CodecVariant) -> None:
        """Its fields are stored in every recording, and sent to the recorder's process."""
        assert type(codec).model_validate(codec.model_dump(mode="json")) == codec
        assert pickle.loads(pickle.dumps(codec)) == codec  # noqa: S301  # our own bytes
        fitted = codec.fitted(128, 2)
        assert type(codec).model_validate(fitted.model_dump(mode="json")) == fitted
        assert name_of(codec)

    @pytest.mark.parametrize("dtype", ["uint8", "<u2"])
    def test_lines_come_back_whatever_they_are(self, codec: CodecVariant, dtype: str) -> None:
        """Dark and saturated lines pack to nearly nothing, and noise not at all."""
        for size in SIZES:
            fitted = codec.fitted(size[1] * np.dtype(dtype).itemsize, np.dtype(dtype).itemsize)
            for what, lines in contents(size, dtype).items():
                data = memoryview(lines.tobytes())
                packed = bytes(fitted.encode(data))
                most = most_stored_bytes(len(data)) - CRC_BYTES
                assert 0 < len(packed) <= most, f"{what} of {size} grew to {len(packed)} bytes"
                assert bytes(fitted.decode(memoryview(packed), len(data))) == data, f"{what} of {size}"
                assert bytes(fitted.encode(data)) == packed, f"{what}: the same lines were packed otherwise"

    def test_threads_may_pack_at_the_same_time(self, codec: CodecVariant) -> None:
        """A recorder packs chunks of both arms in two threads, with one object."""
        fitted = codec.fitted(640, 1)
        chunks = [memoryview(lines.tobytes()) for lines in contents((512, 640), "uint8").values()] * 4
        alone = [bytes(fitted.encode(data)) for data in chunks]
        with ThreadPoolExecutor(4) as threads:
            together = [bytes(packed) for packed in threads.map(fitted.encode, chunks)]
            assert together == alone
            restored = threads.map(lambda packed: bytes(fitted.decode(memoryview(packed), 512 * 640)), alone)
            assert list(restored) == [bytes(data) for data in chunks]

    def test_a_chunk_that_is_cut_short_is_not_taken_for_a_whole_one(self, codec: CodecVariant) -> None:
        """The checksum finds it first, except in files of other writers."""
        fitted = codec.fitted(64, 1)
        data = contents((64, 64), "uint8")["noise"].tobytes()
        packed = bytes(fitted.encode(memoryview(data)))
        try:
            restored = bytes(fitted.decode(memoryview(packed)[: len(packed) // 2], len(data)))
        except Exception:  # noqa: BLE001  # any error will do: the reader reports it as damage
            return
        assert len(restored) != len(data)

    @pytest.mark.parametrize("dtype", ["uint8", "uint16"])
    def test_recorded_lines_are_read_by_us_and_by_zarr_python(
        self, codec: CodecVariant, dtype: str, tmp_path: Path
    ) -> None:
        """zarr-python finds the codec by the entry points of the group ``zarr.codecs``."""
        lines = contents((5 * CHUNK_LINES + 3, 40), np.dtype(dtype).newbyteorder("<").str)["scene"]
        reader = recorded(tmp_path, codec, lines, dtype)
        ours = np.concatenate([reader.chunk(number) for number in range(reader.chunks)])
        np.testing.assert_array_equal(ours[: len(lines)], lines)
        array = zarr.open_array(tmp_path / "lines", mode="r")
        np.testing.assert_array_equal(np.asarray(array[:]), lines)

    def test_a_flipped_bit_is_found_by_the_checksum(self, codec: CodecVariant, tmp_path: Path) -> None:
        """It is of the packed bytes, so that a recording is verified without unpacking."""
        lines = contents((2 * CHUNK_LINES, 40), "uint8")["noise"]
        reader = recorded(tmp_path, codec, lines, "uint8")
        offset, size = reader.entry(1)
        file = tmp_path / reader.file(1)
        content = bytearray(file.read_bytes())
        content[offset + size // 2] ^= 4
        file.write_bytes(content)
        assert (reader.trouble(0), reader.trouble(1)) == (None, "the checksum is wrong")


def contents(size: tuple[int, int], dtype: str) -> dict[str, NDArray[Any]]:
    """Return lines (line, pixel) of several kinds, by name: of packed sizes between nothing and all."""
    draws = np.random.default_rng(size[0])
    most = int(np.iinfo(dtype).max)
    edges = np.where(np.arange(size[1]) % 8 < 4, 0.2, 0.7)
    moving = edges * (1 + 0.2 * np.sin(np.arange(size[0]) / 9))[:, None]
    return {
        "darkness": np.zeros(size, dtype),
        "saturation": np.full(size, most, dtype),
        "scene": draws.poisson(100 * moving).clip(0, most).astype(dtype),
        "noise": draws.integers(0, most, size, endpoint=True, dtype=np.dtype(dtype).newbyteorder("=")).astype(
            dtype
        ),
    }


def name_of(codec: CodecVariant) -> str:
    """Return the name by which a rig file asks for a codec of this class. Raises LookupError without one."""
    for plugin in INSTALLED.found():
        if not INSTALLED.trouble(plugin) and INSTALLED.load(plugin.name) is type(codec):
            return plugin.name
    raise LookupError(f"{type(codec).__name__} is not installed: no entry point of {INSTALLED.name} names it")


def recorded(directory: Path, codec: CodecVariant, lines: NDArray[Any], dtype: str) -> ChunkReader:
    """Write lines as a recording does, in ``directory``/lines, and return their reader."""
    name, item_bytes = name_of(codec), lines.itemsize
    own = [known for known in CODECS if known == name]
    stored: Codec = own[0] if own else as_plugin(name, codec, lines.shape[1] * item_bytes, item_bytes)
    shape = ArrayShape(dtype, lines.shape[1:], CHUNK_LINES, 4, stored)
    (directory / "lines").mkdir()
    writer = ArrayWriter(directory / "lines", shape, durable=False)
    writer.append(lines)
    writer.pad()
    writer.close()
    document = line_array(line_columns(dtype)[0], shape, len(lines))
    (directory / "lines" / "zarr.json").write_bytes(to_json(document))
    return ChunkReader(LocalSource(directory), "lines", document)
