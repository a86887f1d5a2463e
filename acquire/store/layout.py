"""The recording format as Zarr v3 metadata: pure functions that return JSON documents.

::

    NAME.zarr/        zarr.json    the commit record: attributes and the metadata of everything below
      a/  b/          zarr.json    one arm; its own copy of its arrays' metadata
        lines         (line, pixel)
        code_index  code  tick  time  flags       (line)
      events/  gaps/  zarr.json    tables: one 1-D array per column
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from acquire.flags import LineFlag
from acquire.store.shape import ITEM_BYTES, ArrayShape, PluginCodec, codec_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from acquire.lines import TaggedBlock
    from acquire.store.shape import Codec
    from acquire.store.spec import RecordingSpec

Document = dict[str, Any]
"""The content of one zarr.json."""

FORMAT = "acquire-recording/2"
"""Format of new recordings. In format 1 the code's ``seed`` is the register's state, and the user's seed is
not stored; lines that contradict their code have the flag of lines without a tag.
"""
READABLE = ("acquire-recording/1", FORMAT)

DAMAGE = (OSError, ValueError, RuntimeError, LookupError, TypeError, AttributeError, ArithmeticError)
"""Exceptions that zarr and arithmetic raise for wrong metadata or chunks."""
PARSE_ERRORS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""Exceptions raised when a wrong document is parsed; arithmetic: a number may be 0, or 1e999, infinite."""

MAX_READ_BYTES = 2**31
"""Largest chunk that a reader takes into memory; chunks that are written are much smaller."""
MAX_READ_CHUNKS = 1024
"""Largest number of chunks per file that a reader accepts."""

BYTES = {"name": "bytes", "configuration": {"endian": "little"}}
CRC32C = {"name": "crc32c"}
VLEN_UTF8 = {"name": "vlen-utf8", "configuration": {}}
NO_LINE = 2**64 - 1
"""Code index of a row that is not a line: padding of a last chunk, or not on disk."""


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One array of an arm: its name in the recording, its place in a TaggedBlock, and its attributes.

    ``fill`` is the value that a reader finds where nothing is on disk, and the padding of the last chunk.
    """

    name: str
    source: str
    dtype: str
    attributes: dict[str, Any] = field(default_factory=dict)
    fill: int = 0

    def of(self, block: TaggedBlock) -> NDArray[Any]:
        """Return the block's rows of this array."""
        rows: NDArray[Any] = attrgetter(self.source)(block)
        return rows


def line_columns(dtype: str) -> tuple[Column, ...]:
    """Return the arrays of an arm; ``lines`` is (line, pixel) of ``dtype``, the others are (line)."""
    return (Column("lines", "pixels", dtype, LINES_ATTRIBUTES), *TAG_COLUMNS)


LINES_ATTRIBUTES = {
    "long_name": "lines as recorded",
    "units": "DN",
    "description": "row i is the trigger's line first_line + i; a missing line is flagged and filled with 0",
    "coordinates": "time tick code_index",
    "ancillary_variables": "flags code",
}

TAG_COLUMNS = (
    Column(
        "code_index",
        "tags.code_index",
        "uint64",
        {
            "long_name": "index of the exposure code's bit in the line's first sub-step",
            "units": "1",
            "description": "the code's bit k gates the light in sub-step k of the run; one bit per sub-step",
        },
        fill=NO_LINE,
    ),
    Column(
        "code",
        "tags.code",
        "uint8",
        {
            "long_name": "exposure code bits of the line's S new sub-steps",
            "description": "bit u (value 1 << u) is the code's bit code_index + u; 1: light on",
        },
    ),
    Column(
        "tick",
        "tags.tick",
        "uint64",
        {
            "long_name": "trigger clock at which the line's read-out begins",
            "units": "1",
            "description": "ticks since the start of the run; rate: attribute clock of the root",
        },
    ),
    Column(
        "time",
        "tags.time_ns",
        "int64",
        {
            "standard_name": "time",
            "long_name": "UTC at which the line's read-out begins",
            "units": "nanoseconds since 1970-01-01T00:00:00",
            "calendar": "proleptic_gregorian",
        },
    ),
    Column(
        "flags",
        "flags",
        "uint16",
        {
            "long_name": "what is known about the line beyond its pixels",
            "flag_masks": [int(flag) for flag in LineFlag],
            "flag_meanings": " ".join(flag.name.lower() for flag in LineFlag if flag.name),
        },
        fill=int(LineFlag.MISSING),
    ),
)


SAME_IN_BOTH_ARMS = ("code_index", "code", "tick", "time")
"""Arrays whose values follow from the line's number."""


def column_shape(column: Column, spec: RecordingSpec) -> ArrayShape:
    """Return how ``column`` is chunked; a file of any array has the same rows.

    Tags are few bytes, and predictable: their chunks are longer, and packed even if pixels are not. A codec
    of another distribution packs pixels only: without it, all else of a recording can still be read.
    """
    pixels = column.name == "lines"
    codec: Codec = spec.codec
    if not pixels and (codec == "none" or isinstance(codec, PluginCodec)):
        codec = "lz4"
    joined = 1 if pixels else spec.tag_chunks
    return ArrayShape(
        data_type=column.dtype,
        row_shape=(spec.pixels,) if pixels else (),
        chunk_rows=spec.chunk_lines * joined,
        shard_chunks=spec.shard_chunks // joined,
        codec=codec,
    )


def line_array(column: Column, shape: ArrayShape, rows: int) -> Document:
    """Return the metadata of an arm's array of ``rows`` lines."""
    sharding = {
        "chunk_shape": list(shape.chunk_shape),
        "codecs": [BYTES, *packing(shape), CRC32C],
        "index_codecs": [BYTES, CRC32C],
        # Where it can be replaced in place while the file grows.
        "index_location": "start",
    }
    return array_document(
        shape=(rows, *shape.row_shape),
        data_type=shape.data_type,
        dimensions=("line", "pixel")[: len(shape.chunk_shape)],
        chunk_shape=shape.shard_shape,
        codecs=[{"name": "sharding_indexed", "configuration": sharding}],
        attributes=column.attributes
        | ({"codec": shape.codec.origin} if isinstance(shape.codec, PluginCodec) else {}),
        fill=column.fill,
    )


def parse_line_array(document: Document) -> tuple[ArrayShape, int]:
    """Return chunking and rows of an array made by `line_array`. Raises one of `PARSE_ERRORS` for others."""
    (sharding,) = document["codecs"]
    inner = sharding["configuration"]
    rows, *row_shape = map(int, document["shape"])
    chunk_rows, *chunk_rest = map(int, inner["chunk_shape"])
    shard_rows, *shard_rest = map(int, document["chunk_grid"]["configuration"]["chunk_shape"])
    # An array without rows is a valid one; a chunk without rows, or a file without chunks, is not.
    if not row_shape == chunk_rest == shard_rest or min(rows + 1, chunk_rows, shard_rows // chunk_rows) < 1:
        raise ValueError(f"shape {document['shape']} does not fit chunks {inner['chunk_shape']}")
    if inner["index_location"] != "start" or document["data_type"] not in ITEM_BYTES:
        raise ValueError(f"the index is at the {inner['index_location']}, of samples {document['data_type']}")
    codec = codec_of(inner["codecs"], document.get("attributes"))
    shape = ArrayShape(document["data_type"], tuple(row_shape), chunk_rows, shard_rows // chunk_rows, codec)
    if shape.chunk_bytes > MAX_READ_BYTES:
        raise ValueError(f"chunks of {inner['chunk_shape']} samples are too large")
    if shape.shard_chunks > MAX_READ_CHUNKS:
        raise ValueError(f"files of {shape.shard_chunks} chunks are too large")
    return shape, rows


def array_document(
    *,
    shape: Sequence[int],
    data_type: str,
    dimensions: Sequence[str],
    chunk_shape: Sequence[int],
    codecs: list[Document],
    attributes: Mapping[str, Any],
    fill: int = 0,
) -> Document:
    """Return the metadata of any array; the fill value of strings is empty."""
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": list(shape),
        "data_type": data_type,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk_shape)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": "" if data_type == "string" else fill,
        "codecs": codecs,
        "attributes": dict(attributes),
        "dimension_names": list(dimensions),
        "storage_transformers": [],
    }


def group_document(attributes: Mapping[str, Any], nodes: Mapping[str, Document]) -> Document:
    """Return the metadata of a group, with ``nodes`` (path below the group → document) consolidated."""
    return {
        "zarr_format": 3,
        "node_type": "group",
        "attributes": dict(attributes),
        "consolidated_metadata": {
            "kind": "inline",
            "must_understand": False,  # an extension of zarr-python, which other readers may ignore
            "metadata": {path: inner(document) for path, document in nodes.items()},
        },
    }


def to_json(document: Document) -> bytes:
    """Return the bytes of a zarr.json; compact, since it is rewritten at every commit."""
    # No NaN: Python reads it, but it is not JSON, and other libraries refuse the whole document.
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def inner(document: Document) -> Document:
    """Return a node for consolidated metadata, which zarr keeps flat: inner groups have none of their own."""
    if document["node_type"] == "array":
        return document
    return group_document(document["attributes"], {})


def packing(shape: ArrayShape) -> list[Document]:
    """Return the Zarr codec that packs the bytes of a chunk, if any."""
    if shape.codec == "none":
        return []
    if isinstance(shape.codec, PluginCodec):
        return [{"name": shape.codec.zarr_name, "configuration": json.loads(shape.codec.configuration)}]
    blosc = {
        "cname": shape.codec,
        "clevel": 1,
        "shuffle": "bitshuffle",
        "typesize": ITEM_BYTES[shape.data_type],
        "blocksize": 0,
    }
    return [{"name": "blosc", "configuration": blosc}]
