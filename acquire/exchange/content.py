"""The content of an export: one image with three axes, columns along them, and facts; read in blocks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

Block = tuple[tuple[Any, ...], "NDArray[Any]"]
"""A piece of an array with its index; the pieces follow one another in C order."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis of an image: coordinate ``first + i * step`` in ``unit``; ``step`` None for indices."""

    name: str
    step: float | None = None
    first: float = 0.0
    unit: str = "1"


@dataclass(frozen=True, slots=True, eq=False)
class Array:
    """An array that is read in blocks; ``dims`` name its axes."""

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    blocks: Callable[[], Iterator[Block]]
    attributes: dict[str, Any] = field(default_factory=dict)

    @property
    def bytes(self) -> int:
        """Size of all values in memory."""
        return int(np.prod(self.shape)) * self.dtype.itemsize


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """The content of an export; ``kind`` is ``video`` or ``lines``; ``title`` has no unprintable characters.

    ``columns`` lie along axes of the image; arrays in ``beside`` share its first axis and have others of
    their own. ``facts`` is JSON: the origin of the data and the trusted part. ``untrusted`` counts the
    written frames that are not trusted.
    """

    kind: str
    title: str
    axes: tuple[Axis, ...]
    image: Array
    columns: tuple[Array, ...]
    facts: dict[str, Any]
    untrusted: int = 0
    beside: tuple[Array, ...] = ()


def little(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return a type in little-endian byte order, that of the written files."""
    return np.dtype(dtype).newbyteorder("<")


def block(index: tuple[Any, ...], values: NDArray[Any]) -> Block:
    """Return a piece of an array in the byte order of the written files."""
    return index, values.astype(little(values.dtype), copy=False)
