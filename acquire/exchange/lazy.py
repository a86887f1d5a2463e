"""Lazy arrays for viewers, which read only what is shown, however long a recording is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.store.present import flags_of, present_values

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.store import Recording, VideoFile

PAGE_LINES = 1024
"""Lines of a recording that are shown as one picture."""
MOST_BYTES = 2**29
"""Largest size that is read at once, so that a viewer cannot fill the memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Stack:
    """Pictures (number, row, column) that ``picture`` reads one by one; it is sliced like a NumPy array."""

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    picture: Callable[[int], NDArray[Any]]

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> NDArray[Any]:
        """Read the selected pictures. Raises UsageError for more than `MOST_BYTES`."""
        # As in NumPy, an empty index selects everything.
        first, *rest = (index if isinstance(index, tuple) else (index,)) or (...,)
        # A viewer may slice only the last axes: the ellipsis then stands for the pictures, too.
        if first is Ellipsis:
            first, rest = slice(None), [..., *rest]
        numbers = np.arange(self.shape[0])[first]
        if numbers.ndim == 0:
            picture: NDArray[Any] = self.picture(int(numbers))[tuple(rest)]
            return picture
        wanted = len(numbers) * math.prod(self.shape[1:]) * self.dtype.itemsize
        if wanted > MOST_BYTES:
            raise UsageError(
                f"{len(numbers)} pictures at once would be {wanted} bytes",
                possible=f"up to {MOST_BYTES} bytes",
                hint="the slider, for one picture at a time; acquire export, for a part",
            )
        found = np.empty((len(numbers), *self.shape[1:]), self.dtype)
        for place, number in zip(found, numbers.tolist(), strict=True):
            # one by one: only the result has to fit into memory
            place[:] = self.picture(number)
        return found[(slice(None), *rest)]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        # NumPy 2 passes `copy`; pictures are read anew in any case.
        return np.asarray(self[:], dtype)


def pages(recording: Recording, arm: str) -> Stack:
    """Return the lines of an arm in pages of `PAGE_LINES`; missing lines and padding are 0."""
    stream, lines = recording.camera(arm), recording.lines

    def picture(number: int) -> NDArray[Any]:
        start = number * PAGE_LINES
        stop = min(lines, start + PAGE_LINES)
        found = np.zeros((PAGE_LINES, stream.pixels), stream.dtype)
        flags = flags_of(recording, arm, start, stop)
        found[: stop - start] = present_values(recording, arm, "lines", start, flags)
        return found

    return Stack((max(1, -(-lines // PAGE_LINES)), PAGE_LINES, stream.pixels), stream.dtype, picture)


def frames(video: VideoFile, kept: range) -> Stack:
    """Return some frames of a video."""
    _, rows, columns = video.video.shape

    def picture(number: int) -> NDArray[Any]:
        found: NDArray[Any] = video.frames(kept[number], kept[number] + 1)[0]
        return found

    return Stack((len(kept), rows, columns), video.video.dtype, picture)
