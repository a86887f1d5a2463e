"""A plug-in's codec as a codec of zarr-python, which looks for it in the entry points ``zarr.codecs``."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from functools import cache
from math import prod
from typing import TYPE_CHECKING, Any, ClassVar, Self

from zarr.abc.codec import BytesBytesCodec

if TYPE_CHECKING:
    from zarr.core.array_spec import ArraySpec
    from zarr.core.buffer import Buffer
    from zarr.core.common import JSON

    from acquire.store.variant import CodecVariant


@dataclass(frozen=True)
class VariantCodec(BytesBytesCodec):
    """Packs and unpacks chunks for zarr-python as ``codec`` does; a subclass for every class of codec."""

    variant: ClassVar[type[CodecVariant]]
    is_fixed_size = False
    codec: CodecVariant

    @classmethod
    def from_dict(cls, data: dict[str, JSON]) -> Self:
        """Return the codec that the metadata of an array describe. Raises ValueError for other parameters."""
        return cls(cls.variant.model_validate(data.get("configuration", {})))

    def to_dict(self) -> dict[str, JSON]:
        """Return the codec as the metadata of an array state it."""
        return {"name": self.variant.zarr_name, "configuration": self.codec.model_dump(mode="json")}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Raise NotImplementedError, as the other codecs of zarr whose size depends on the content do."""
        raise NotImplementedError

    async def _encode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> Buffer | None:
        packed = await asyncio.to_thread(self.codec.encode, memoryview(chunk_data.to_bytes()))
        return chunk_spec.prototype.buffer.from_bytes(bytes(packed))

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> Buffer:
        size = prod(chunk_spec.shape) * chunk_spec.dtype.to_native_dtype().itemsize
        whole = await asyncio.to_thread(self.codec.decode, memoryview(chunk_data.to_bytes()), size)
        return chunk_spec.prototype.buffer.from_bytes(bytes(whole))


@cache
def zarr_codec_of(variant: type[CodecVariant]) -> type[BytesBytesCodec]:
    """Return the class for zarr-python of a plug-in's codec; the same one every time."""
    about: dict[str, Any] = {"variant": variant, "__doc__": variant.__doc__, "__module__": variant.__module__}
    return type(f"{variant.__name__}.zarr_codec", (VariantCodec,), about)
