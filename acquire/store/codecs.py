"""Codecs of chunks (none, blosc with bit shuffle, or a plug-in's), and how fast ours are on this host.

Plain Zarr can unpack the chunks of ours. Every chunk carries a crc32c, since blosc does not detect flipped
bits. The codecs of plug-ins are in `acquire.store.plugin_codecs`.
"""

from __future__ import annotations

import struct
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numcodecs import blosc

from acquire.errors import UsageError
from acquire.store import plugin_codecs
from acquire.store.pages import PAGE
from acquire.store.shape import CODECS, CRC_BYTES, OwnCodec, PluginCodec, crc32c

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from typing_extensions import Buffer

    from acquire.config import RigConfig
    from acquire.store.shape import Codec

_MOST_KEPT = 4
BLOSC_HEADER = 16
"""Bytes; the second word is the unpacked size, the fourth the packed one."""

blosc.use_threads = False  # its own threads serve one caller at a time; the writer has a pool instead


@dataclass(frozen=True, slots=True)
class CodecSpeed:
    """Speed of one thread on sample lines, in MB of lines per second, and compression ratio."""

    codec: OwnCodec
    megabytes_per_s: float
    ratio: float


@dataclass(frozen=True, slots=True)
class CodecChoice:
    """The codec chosen for a line rate, and the measurements behind the choice; JSON by `to_attrs`."""

    codec: OwnCodec
    reason: str
    needed_megabytes_per_s: float
    measured: tuple[CodecSpeed, ...]

    def to_attrs(self) -> dict[str, Any]:
        """Return the choice as JSON, the attribute ``codec_choice`` of recordings."""
        return asdict(self)


def configured_codec(config: RigConfig, auto: OwnCodec) -> Codec:
    """Return the codec of a rig's lines; ``auto`` is the one to use where the rig leaves the choice."""
    name, options = config.recording.codec, config.recording.codec_options
    if name == "auto":
        return auto
    for own in CODECS:
        if name == own:
            return own
    item_bytes = np.dtype(config.cameras.a.dtype).itemsize
    return plugin_codecs.as_plugin(name, options, config.pixels * item_bytes, item_bytes)


def encode(rows: NDArray[Any], codec: Codec) -> NDArray[np.uint8]:
    """Return the bytes of one chunk, without checksum; ``rows`` is C-contiguous and little-endian.

    Raises `plugin_codecs.EncodingError` if a plug-in's codec fails.
    """
    if codec == "none":
        return rows.reshape(-1).view(np.uint8)
    if isinstance(codec, PluginCodec):
        return plugin_codecs.encode(rows.reshape(-1).view(np.uint8), codec)
    # Bit shuffle puts bits of equal weight together: the upper ones hardly change along a line, although the
    # lowest are noise.
    # Without the shuffle, lz4 is slower on lines of a sensor, and packs them less (measured).
    return np.frombuffer(blosc.compress(rows, codec.encode(), 1, blosc.BITSHUFFLE), np.uint8)


class EncodeOnce:
    """Packs chunks only once that come from both arms with the same content, such as code and ticks."""

    def __init__(self) -> None:
        self._packed: dict[tuple[int, bytes], NDArray[np.uint8]] = {}

    def __call__(self, chunk: int, rows: NDArray[Any], codec: Codec) -> NDArray[np.uint8]:
        """Return `encode` of the rows of chunk number ``chunk``."""
        # The checksum is part of the key: arms that lost different lines do not have the same rows.
        key = chunk, crc32c(rows.data)
        packed = self._packed.pop(key, None)
        if packed is None:
            packed = self._packed[key] = encode(rows, codec)
            # An arm that is further behind packs its own; one that lost lines never asks for this chunk.
            if len(self._packed) > _MOST_KEPT:
                del self._packed[next(iter(self._packed))]
        return packed


def decode(payload: Buffer, codec: Codec, size: int) -> NDArray[np.uint8]:
    """Return the ``size`` unpacked bytes; `check_size` must have passed.

    Raises ValueError if a plug-in's codec cannot unpack them, and UsageError if it is not installed.
    """
    if isinstance(codec, PluginCodec):
        return plugin_codecs.decode(memoryview(payload), codec, size)
    samples: NDArray[np.uint8] = np.frombuffer(
        memoryview(payload) if codec == "none" else blosc.decompress(payload), np.uint8
    )
    return samples


def check_size(payload: memoryview, size: int, codec: Codec) -> None:
    """Raise ValueError unless ``payload`` has the length that its header states, and unpacks to ``size``."""
    # To be called before unpacking, which allocates whatever size a damaged header states. What a plug-in
    # packs has no header that is known here: `decode` checks it.
    if isinstance(codec, PluginCodec):
        return
    have, stored = len(payload), len(payload)
    if codec != "none" and have >= BLOSC_HEADER:
        have, stored = struct.unpack_from("<4xI4xI", payload)
    if (have, stored) != (size, len(payload)):
        raise ValueError(f"{len(payload)} bytes do not make {size}")


def stored_size(header: bytes, size: int, codec: OwnCodec) -> int:
    """Return the size on disk, with checksum, of a chunk of ``size`` bytes by its header; 0 without one."""
    if len(header) < BLOSC_HEADER:
        return size + CRC_BYTES if codec == "none" else 0
    # Without a codec there is no header: a chunk has its full size, wherever it is.
    stored = size if codec == "none" else int(struct.unpack_from("<12xI", header)[0])
    return stored + CRC_BYTES


def checked_size(data: bytes) -> int:
    """Return the size of the chunk, with checksum, that ``data`` begins with; 0 if it is no intact one.

    It is found by the checksum at its end, behind which its last page is filled with 0: for codecs whose
    packed bytes do not state their length.
    """
    done, before = 0, bytes(CRC_BYTES)  # so many bytes have the checksum `before`
    for page in range(0, len(data), PAGE):
        end = page + len(data[page : page + PAGE].rstrip(b"\0"))
        # The checksum may itself end in zeros.
        for size in range(max(end, page + 1), min(end + CRC_BYTES, page + PAGE, len(data)) + 1):
            stop = size - CRC_BYTES
            if stop > done and crc32c(data[done:stop], before) == data[stop:size]:
                return size
        # A checksum may begin in this page and end in the next one.
        behind = page + PAGE - CRC_BYTES
        before, done = crc32c(data[done:behind], before), behind
    return 0


def choose_codec(
    lines: NDArray[Any],
    bytes_per_s: float,
    disk_bytes_per_s: float,
    *,
    threads: int = 1,
    margin: float = 1.5,
) -> CodecChoice:
    """Choose the codec that records ``bytes_per_s`` here with ``margin``; takes a few tenths of a second.

    ``lines`` (line, pixel) are like those to come, some MB of them; ``disk_bytes_per_s`` is the rate that the
    disk sustains; ``threads`` pack in parallel. Among the codecs that sustain the rate with ``margin`` the
    one with the smallest recording is chosen; if none does, the fastest.
    """
    if not lines.size or bytes_per_s <= 0 or disk_bytes_per_s <= 0:
        raise UsageError(
            f"no codec can be chosen for {lines.shape} lines at {bytes_per_s:g} B/s and a disk of "
            f"{disk_bytes_per_s:g} B/s",
            possible="all above 0",
        )
    measured = tuple(measure_codec(lines, codec) for codec in CODECS)
    needed = bytes_per_s * margin
    # Packing and writing run in parallel: the slower one counts.
    held = {
        speed.codec: min(speed.megabytes_per_s * 1e6 * threads, disk_bytes_per_s * speed.ratio)
        for speed in measured
    }
    able = [speed for speed in measured if held[speed.codec] >= needed]
    if able:
        best = max(able, key=lambda speed: speed.ratio)
        reason = f"the smallest that holds {needed / 1e6:.0f} MB/s"
    else:
        best = max(measured, key=lambda speed: held[speed.codec])
        reason = f"none holds {needed / 1e6:.0f} MB/s; this one {held[best.codec] / 1e6:.0f} MB/s"
    return CodecChoice(best.codec, reason, needed / 1e6, measured)


def measure_codec(lines: NDArray[Any], codec: OwnCodec, seconds: float = 0.1) -> CodecSpeed:
    """Measure how fast one thread packs ``lines`` with checksum: the best of the rounds within ``seconds``.

    Lines that fit into the processor's caches stay there from round to round. That flatters ``none``, of
    which only the checksum is measured; but its rate is limited by the disk anyway, never by this one.
    """
    rows = np.ascontiguousarray(lines)
    # The best round counts: others may have been interrupted by other programs.
    best, until = float("inf"), time.perf_counter() + seconds
    while (begun := time.perf_counter()) < until or best == float("inf"):
        payload = encode(rows, codec)
        crc32c(payload.data)
        best = min(best, time.perf_counter() - begun)
    return CodecSpeed(codec, rows.nbytes / best / 1e6, rows.nbytes / len(payload))
