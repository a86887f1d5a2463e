"""Repairs inside the files of a recording that nobody writes: torn indices, lost chunks.

The caller forces them to the medium before it rewrites the recording's root.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.store.chunks import DamagedChunkError
from acquire.store.codecs import encode
from acquire.store.pages import PAGE, page_up
from acquire.store.refusals import shows_damage
from acquire.store.shape import ABSENT, crc32c, pack_index

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.store.chunks import ChunkReader
    from acquire.store.files import Disk


def mend_index(disk: Disk, path: Path, reader: ChunkReader, shard: int, *, grow: bool) -> bool:
    """Rewrite the index of a shard if its checksum is wrong; return whether it was changed.

    Replacing an index adds entries and leaves the others: each entry of a torn one is either right, as its
    chunk's own checksum shows, or invalid. With ``grow``, chunks that were written after the last one are
    added, too: the next commit would have put them into the index.
    """
    entries, intact = reader.index(shard)
    first = shard * len(entries)
    mended = [(ABSENT, ABSENT)] * len(entries)
    for slot, (offset, size) in enumerate(entries):
        # The chunks of an intact index are checked by the scan, which flags what is lost.
        if intact or _holds(reader, first + slot, offset, size):
            mended[slot] = offset, size
    if grow:
        slot = max((slot + 1 for slot, (offset, _) in enumerate(mended) if offset != ABSENT), default=0)
        offset = page_up(sum(mended[slot - 1])) if slot else PAGE
        while slot < len(mended):
            size = reader.size_at(first + slot, offset)
            if not _holds(reader, first + slot, offset, size):
                break
            mended[slot] = offset, size
            slot, offset = slot + 1, page_up(offset + size)
    # Not touched without need: `patch` refuses the read-only and hard-linked files of an archive.
    if intact and mended == entries:
        return False
    disk.patch(path / reader.shard_file(shard), pack_index(mended), 0)
    return True


def rewrite_chunk(disk: Disk, path: Path, reader: ChunkReader, chunk: int, rows: NDArray[Any]) -> None:
    """Replace a chunk by ``rows``, at the end of its file, which is created if there is none."""
    # First the chunk, then its entry: a concurrent reader finds the old or the new one, and an interrupted
    # recovery loses nothing. The old chunk's bytes stay unused.
    file = path / reader.file(chunk)
    entries, _ = reader.index(chunk // reader.shape.shard_chunks)
    payload = encode(rows, reader.shape.codec).tobytes()
    data = payload + crc32c(payload)
    if file.exists():
        offset = page_up(file.stat().st_size)
        disk.patch(file, data, offset)
    else:
        offset = PAGE
        disk.make_directory(file.parent, parents=True)
        disk.write_file(file, bytes(PAGE) + data, durable=False)
    entries[chunk % len(entries)] = offset, len(data)
    disk.patch(file, pack_index(entries), 0)


def _holds(reader: ChunkReader, chunk: int, offset: int, size: int) -> bool:
    """Return whether there is an intact chunk at this place; impossible entries are not read.

    Raises OSError if that cannot be found out now.
    """
    if not 0 < size <= reader.most_bytes or offset % PAGE or offset < PAGE:
        return False
    try:
        reader.payload(chunk, offset, size)
    except DamagedChunkError:
        return False
    except OSError as error:
        if not shows_damage(error):
            raise
        return False
    return True
