"""What an export writes: one image of three axes, columns beside it, and facts; all read in blocks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

Block = tuple[tuple[Any, ...], "NDArray[Any]"]
"""Where a piece of an array belongs (an index), and the piece; pieces follow one another in C order."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis of an image: coordinate ``first + i * step`` in ``unit``; ``step`` None: numbers of things."""

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
        return int(np.prod(self.shape)) * self.dtype.itemsize


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """What is exported, a ``kind`` of ``video`` or ``lines``.

    ``columns`` lie along axes of the image; ``beside`` have its first axis and others of their own.
    ``facts`` is JSON: where it comes from, and what of it can be trusted. ``untrusted`` counts the frames
    among those that are written which are not sampled in full.
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
    """The same, with the byte order of the files that are written."""
    return np.dtype(dtype).newbyteorder("<")


def block(index: tuple[Any, ...], values: NDArray[Any]) -> Block:
    """A piece of an array as it is written."""
    return index, values.astype(little(values.dtype), copy=False)
