"""One growing array and the small tables, read back by plain zarr-python."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.store.array_writer import ArrayWriter
from acquire.store.files import DISK, Publisher
from acquire.store.layout import Column, line_array, to_json
from acquire.store.pages import PAGE
from acquire.store.shape import ArrayShape, index_bytes, unpack_index
from acquire.store.table import MAX_TEXT, Table, TableColumn, Vocabulary

DTYPES = ("uint8", "uint16", "uint64", "int64")


def publish(writer: ArrayWriter, rows: int) -> zarr.Array:
    """Write the array's metadata for ``rows`` rows and open it."""
    document = line_array(Column("lines", "pixels", "", {"long_name": "x"}), writer.shape, rows)
    (writer.directory / "zarr.json").write_bytes(to_json(document))
    return zarr.open_array(writer.directory, mode="r")


def noise(count: int, shape: ArrayShape) -> np.ndarray:
    generator = np.random.default_rng(count)
    return generator.integers(1, 250, (count, *shape.row_shape)).astype(shape.dtype)


@settings(max_examples=60, deadline=None)
@given(
    splits=st.lists(st.integers(0, 40), max_size=12),
    dtype=st.sampled_from(DTYPES),
    pixels=st.sampled_from([None, 1, 5, 64]),
    chunk_rows=st.integers(1, 33),
    shard_chunks=st.sampled_from([1, 2, 3, 255]),
    codec=st.sampled_from(["none", "lz4", "zstd"]),
    contiguous=st.booleans(),
)
def test_any_splits_read_back_equal(splits, dtype, pixels, chunk_rows, shard_chunks, codec, contiguous):
    row_shape = () if pixels is None else (pixels,)
    shape = ArrayShape(dtype, row_shape, chunk_rows, shard_chunks, codec)
    rows = noise(sum(splits), shape)
    source = rows if contiguous else np.repeat(rows, 2, axis=0)[::2]
    with TemporaryDirectory() as directory:
        writer = ArrayWriter(Path(directory), shape, durable=False)
        start = 0
        for split in splits:
            writer.append(source[start : start + split])
            start += split
            assert writer.rows == start
            assert writer.written_rows == start // chunk_rows * chunk_rows
            np.testing.assert_array_equal(publish(writer, writer.whole_rows)[:], rows[: writer.whole_rows])
        writer.settle()
        whole = writer.whole_rows
        assert whole == len(rows) // chunk_rows * chunk_rows
        np.testing.assert_array_equal(publish(writer, whole)[:], rows[:whole])
        writer.pad()
        writer.close()
        np.testing.assert_array_equal(publish(writer, len(rows))[:], rows)


def test_chunks_lie_on_pages_and_the_index_fits_the_first(tmp_path):
    shape = ArrayShape("uint16", (7,), 3, 255, "none")
    writer = ArrayWriter(tmp_path, shape, durable=True)
    writer.append(noise(255 * 3, shape))
    writer.settle()
    writer.close()
    (file,) = (tmp_path / "c").rglob("0/0")
    index, intact = unpack_index(file.read_bytes()[: index_bytes(255)], 255)
    assert intact
    offsets, sizes = zip(*index, strict=True)
    assert not any(offset % PAGE for offset in offsets)
    assert offsets[0] == PAGE
    assert set(sizes) == {3 * 7 * 2 + 4}
    assert writer.bytes_written == sum(sizes)


def test_a_flipped_bit_is_noticed(tmp_path):
    shape = ArrayShape("uint16", (7,), 4, 2, "lz4")
    writer = ArrayWriter(tmp_path, shape, durable=False)
    writer.append(noise(8, shape))
    writer.settle()
    writer.close()
    with (tmp_path / "c" / "0" / "0").open("r+b") as file:
        file.seek(PAGE + 30)
        byte = file.read(1)[0]
        file.seek(PAGE + 30)
        file.write(bytes([byte ^ 4]))
    array = publish(writer, 8)
    with pytest.raises(ValueError, match="checksum"):
        array[0:4]
    np.testing.assert_array_equal(array[4:8], noise(8, shape)[4:8])


def open_table(table: Table, tmp_path: Path) -> zarr.Group:
    table.publish(Publisher(tmp_path / "scratch"))
    return zarr.open_group(table.directory, mode="r")


def test_table_grows_and_counts_what_does_not_fit(tmp_path):
    columns = (
        TableColumn("line", "uint64"),
        TableColumn("kind", "uint8", {}, Vocabulary("mark")),
        TableColumn("text", "string"),
    )
    table = Table(tmp_path / "events", "event", columns, capacity=3)
    table.create(DISK)
    assert open_table(table, tmp_path)["line"].shape == (0,)
    table.add({"line": 2**63, "kind": "mark", "text": "grün ☃"})
    early = open_table(table, tmp_path)
    table.add({"line": 2, "kind": "power lost", "text": "x" * (MAX_TEXT + 9)})
    for _ in range(3):
        table.add({"line": 3, "kind": "mark", "text": ""})
    group = open_table(table, tmp_path)
    assert group["line"][:].tolist() == [2**63, 2, 3]
    assert early["line"][:].tolist() == [2**63]
    assert group["kind"][:].tolist() == [1, 2, 1]
    assert group["kind"].attrs["flag_meanings"] == "other mark power_lost"
    texts = [str(text) for text in group["text"][:]]
    assert texts[0] == "grün ☃"
    assert texts[1] == "x" * (MAX_TEXT - 1) + "…"
    assert dict(group.attrs) == {"capacity": 3, "not_listed": 2}


def test_an_unchanged_table_is_not_rewritten(tmp_path):
    table = Table(tmp_path / "t", "row", (TableColumn("n", "uint8"),), capacity=3)
    table.create(DISK)
    open_table(table, tmp_path)
    before = (tmp_path / "t" / "zarr.json").stat().st_ino
    open_table(table, tmp_path)
    assert (tmp_path / "t" / "zarr.json").stat().st_ino == before


def test_vocabulary_is_bounded():
    words = Vocabulary(limit=3)
    assert [words.value(word) for word in ("a", "b c", "d", "a", "")] == [1, 2, 0, 1, 0]
    assert words.attributes() == {"flag_values": [0, 1, 2], "flag_meanings": "other a b_c"}


def test_metadata_is_json_that_zarr_writes_itself(tmp_path):
    """Our document of an array is the one that zarr-python makes for the same array."""
    shape = ArrayShape("uint16", (7,), 4, 2, "zstd")
    ours = line_array(Column("lines", "pixels", "", {"long_name": "x"}), shape, 10)
    zarr.create_array(
        tmp_path,
        shape=(10, 7),
        dtype="uint16",
        shards={"shape": (8, 7), "index_location": "start"},
        chunks=(4, 7),
        compressors=[
            zarr.codecs.BloscCodec(cname="zstd", clevel=1, shuffle="bitshuffle"),
            zarr.codecs.Crc32cCodec(),
        ],
        dimension_names=("line", "pixel"),
        attributes={"long_name": "x"},
    )
    assert ours == json.loads((tmp_path / "zarr.json").read_bytes())
