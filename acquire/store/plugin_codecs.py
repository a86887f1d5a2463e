"""Chunks that a plug-in's codec packs (`acquire.store.variant`).

It is looked up when its first chunk is packed or unpacked, so that a recording opens without it. It packs
pixels only: times, flags and tables, and so lists, summaries and recovery, do not need it.
"""

from __future__ import annotations

import errno
import json
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import ConfigError, UsageError
from acquire.plugins import CODECS
from acquire.store.shape import CRC_BYTES, PluginCodec, most_stored_bytes
from acquire.text import shown

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.store.shape import Codec
    from acquire.store.variant import CodecVariant


class EncodingError(OSError):
    """A plug-in's codec failed to pack lines: as with a disk, those that were written before stay."""


def as_plugin(name: str, options: Any, line_bytes: int, item_bytes: int) -> PluginCodec:
    """Return a plug-in's codec as it is stored. ``options`` is its `CodecVariant`, for lines of any size."""
    fitted: CodecVariant = options.fitted(line_bytes, item_bytes)
    if not isinstance(fitted, type(options)):
        raise ConfigError(
            f"codec {name!r}: fitted() gave back {shown(fitted)}", possible=f"a {type(options).__name__}"
        )
    configuration = json.dumps(fitted.model_dump(mode="json"), sort_keys=True)
    (plugin,) = (each for each in CODECS.found() if each.name == name and not each.refused)
    return PluginCodec(name, fitted.zarr_name, configuration, plugin.distribution, plugin.version)


@cache
def variant_of(codec: PluginCodec) -> CodecVariant:
    """Return the installed codec. Raises UsageError, which names what to install, if it cannot be used."""
    try:
        return _installed(codec)
    # Also of pydantic, which is a ValueError: another version of the plug-in may have other parameters.
    except (ConfigError, ValueError) as error:
        why = error.message if isinstance(error, ConfigError) else str(error)
        raise UsageError(
            f"the pixels are packed by the codec {codec.name!r} of {codec.distribution} {codec.version}, "
            f"which cannot be used here: {why}",
            possible="everything but the pixels can be read without it",
            hint=f"pip install '{codec.distribution}=={codec.version}'",
        ) from error


def _installed(codec: PluginCodec) -> CodecVariant:
    found: type[CodecVariant] = CODECS.load(codec.name)
    if found.zarr_name != codec.zarr_name:
        raise ConfigError(
            f"the installed codec of that name is {found.zarr_name!r} in Zarr, and not {codec.zarr_name!r}"
        )
    return found.model_validate(json.loads(codec.configuration))


def missing_codec(codec: Codec) -> str:
    """Return why a codec cannot be used here, and what to install; empty if it can."""
    try:
        if isinstance(codec, PluginCodec):
            variant_of(codec)
    except UsageError as error:
        return f"{error.message}; try: {error.hint}"
    return ""


def encode(data: NDArray[np.uint8], codec: PluginCodec) -> NDArray[np.uint8]:
    """Return the packed bytes of one chunk, without checksum. Raises `EncodingError` if the codec fails."""
    try:
        packed: NDArray[np.uint8] = np.frombuffer(variant_of(codec).encode(data.data.toreadonly()), np.uint8)
    except Exception as error:  # somebody else's codec may fail in any way
        raise _failed(codec, f"{type(error).__name__}: {error}") from error
    # An empty chunk would count as absent, and readers refuse one that is larger.
    if not 0 < len(packed) <= most_stored_bytes(data.nbytes) - CRC_BYTES:
        raise _failed(codec, f"{data.nbytes} bytes were packed into {len(packed)}")
    return packed


def decode(payload: memoryview, codec: PluginCodec, size: int) -> NDArray[np.uint8]:
    """Return the ``size`` unpacked bytes of a chunk.

    Raises ValueError if the codec cannot unpack them, and UsageError if it cannot be used here.
    """
    variant = variant_of(codec)
    try:
        samples: NDArray[np.uint8] = np.frombuffer(variant.decode(payload.toreadonly(), size), np.uint8)
    except MemoryError:  # which says nothing about the chunk
        raise
    except Exception as error:  # somebody else's codec may fail in any way
        raise ValueError(f"codec {codec.name!r} failed: {type(error).__name__}: {error}") from error
    if len(samples) != size:
        raise ValueError(f"codec {codec.name!r} has unpacked {len(samples)} bytes in place of {size}")
    return samples


def prove(rows: NDArray[Any], codec: Codec) -> None:
    """Raise ConfigError unless a plug-in's codec gives back rows of lines that it has packed.

    What it does not give back would be missed when the scene is gone.
    """
    if not isinstance(codec, PluginCodec):
        return
    data = rows.reshape(-1).view(np.uint8)
    try:
        same = np.array_equal(decode(encode(data, codec).data, codec, len(data)), data)
        why = "" if same else f"codec {codec.name!r} has unpacked other bytes than it was given"
    except (EncodingError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
    if why:
        raise ConfigError(
            f"{codec.distribution} {codec.version} cannot pack lines: {why}",
            hint="another recording.codec: lz4 and zstd are ours",
        )


def _failed(codec: PluginCodec, why: str) -> EncodingError:
    return EncodingError(errno.EINVAL, f"codec {codec.name!r} of {codec.distribution} failed: {why}")
