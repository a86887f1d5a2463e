"""A rig's view of a codec: its options, and how a chunk of lines is packed and unpacked.

::

    rig file    codec = "NAME", codec_options ─▶ CodecVariant ─fitted─▶ encode     recorder
    zarr.json   name, configuration           ─▶ CodecVariant ────────▶ decode     our readers
                                                 CodecVariant.zarr_codec           zarr-python

The fields of the class are the configuration of its Zarr codec, so that whoever reads the array knows all
that the recorder knew. Our own codecs are here too, for lists, schemas and the public tests; on the way of
lines they are called by their names (`acquire.store.codecs`), since importing pydantic takes a reader 0.3 s.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, Self, TypeAlias

import numpy as np

from acquire.config.base import FrozenModel
from acquire.store import codecs

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from zarr.abc.codec import BytesBytesCodec

    from acquire.store.shape import OwnCodec

Bytes: TypeAlias = "bytes | bytearray | memoryview | NDArray[np.uint8]"
"""What a codec may return."""


class _ZarrCodec:
    """The Zarr codec of the class that it is read from; zarr is imported only then."""

    def __get__(self, instance: object, owner: type[CodecVariant]) -> type[BytesBytesCodec]:
        from acquire.store.zarr_codec import zarr_codec_of

        return zarr_codec_of(owner)


class CodecVariant(FrozenModel, ABC):
    """A codec with its options (``[recording.codec_options]``), none by default. Named by an entry point.

    Attributes
    ----------
    zarr_name : its name in the metadata of arrays, unique among all Zarr codecs: with a prefix of yours
    zarr_codec : the class for zarr-python: an entry point of the group ``zarr.codecs`` with the name
        ``zarr_name`` makes recordings readable in programs that know nothing of ours
    """

    zarr_name: ClassVar[str] = ""
    zarr_codec: ClassVar[_ZarrCodec] = _ZarrCodec()

    @classmethod
    def flaw(cls) -> str:
        """Return what is missing in the class, for the list of plug-ins; empty if nothing is."""
        return "" if cls.zarr_name else "needs zarr_name, its name in the metadata of arrays"

    def fitted(self, line_bytes: int, item_bytes: int) -> Self:  # noqa: ARG002  # for those that need them
        """Return the codec for lines of ``line_bytes`` bytes and samples of ``item_bytes`` (1 or 2) bytes.

        The default returns itself; a codec that makes use of them keeps them in fields.
        """
        return self

    @abstractmethod
    def encode(self, data: memoryview) -> Bytes:
        """Return the packed bytes of whole lines, at most twice as many; several threads call it at once.

        Whatever it raises ends the recording with the chunks that are on disk.
        """

    @abstractmethod
    def decode(self, data: memoryview, size: int) -> Bytes:
        """Return the ``size`` bytes that ``data`` was made of. Raises ValueError if it is damaged.

        The checksum of ``data`` has been verified.
        """


class Uncompressed(CodecVariant):
    """Bytes as they are: the least work, and the most room."""

    @classmethod
    def flaw(cls) -> str:
        """Return nothing: without a codec there is no name in Zarr."""
        return ""

    def encode(self, data: memoryview) -> Bytes:
        """Return ``data`` itself."""
        return data

    def decode(self, data: memoryview, size: int) -> Bytes:  # noqa: ARG002
        """Return ``data`` itself."""
        return data


class _Blosc(CodecVariant):
    zarr_name: ClassVar[str] = "blosc"
    cname: ClassVar[OwnCodec]

    def encode(self, data: memoryview) -> Bytes:
        """Return the bytes packed by blosc."""
        return codecs.encode(np.frombuffer(data, np.uint8), self.cname)

    def decode(self, data: memoryview, size: int) -> Bytes:
        """Return the unpacked bytes. Raises ValueError if the header states another size."""
        codecs.check_size(data, size, self.cname)
        return codecs.decode(data, self.cname, size)


class Lz4(_Blosc):
    """blosc with bit shuffle and lz4: keeps up with fast cameras."""

    cname: ClassVar[OwnCodec] = "lz4"


class Zstd(_Blosc):
    """blosc with bit shuffle and zstd: smaller, and slower."""

    cname: ClassVar[OwnCodec] = "zstd"
