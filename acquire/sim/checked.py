"""Scenes of other distributions, whose light is checked where it is first taken.

Negative light would be subtracted from that of other sub-steps, and then recorded as some DN. Our own scenes
check what a user gives them: files (`acquire.sim.media`) and functions (`acquire.sim.functions`).
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import StoreError, UsageError
from acquire.guarded import AUTHOR
from acquire.sim.light import first_unfit
from acquire.sim.scene import MaskScene, SeparableScene, frames_at
from acquire.text import system_words

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.sim.scene import Scene


def checked_scene(scene: Scene, whose: str, *, every_frame: bool = True) -> Scene:
    """Return the same scene, which raises UsageError for light that is negative or not finite.

    ``whose`` is its kind, name and distribution. Without ``every_frame``, the light of frames is left to
    whoever else looks at them; masks and intensities cost nothing.
    """
    if isinstance(scene, SeparableScene):
        return _CheckedMasks(scene, whose)
    return _CheckedFrames(scene, whose, every_frame)


class _CheckedMasks(MaskScene):
    def __init__(self, scene: SeparableScene, whose: str) -> None:
        self._scene, self._whose = scene, whose
        self.masks = scene.masks
        if (found := first_unfit(self.masks)) is not None:
            mask, row, column = found
            place = f"mask {mask}, pixel ({row}, {column})"
            raise _unfit(whose, self.masks[found], place)

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        with _files(self._whose):
            light = self._scene.intensity(first, count, substep_s)
        if (found := first_unfit(light)) is not None:
            source, step = found
            masks = np.argwhere(self.masks[source])
            row, column = masks[0] if len(masks) else (0, 0)
            where = (
                f"sub-step {first + step}" if substep_s is None else f"step {first + step} of {substep_s:g} s"
            )
            place = f"{where}, source {source}, which lights pixel ({row}, {column})"
            raise _unfit(self._whose, light[found], place)
        return light


class _CheckedFrames:
    def __init__(self, scene: Scene, whose: str, every_frame: bool) -> None:
        self._scene, self._whose, self._every_frame = scene, whose, every_frame

    @property
    def size(self) -> int:
        return self._scene.size

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        with _files(self._whose):
            frames = frames_at(self._scene, substeps)
        wanted = (len(substeps), self.size, self.size)
        if np.shape(frames) != wanted:
            raise UsageError(
                f"{self._whose} gave back shape {np.shape(frames)} for {wanted[0]} frames",
                possible=f"shape {wanted}",
                hint=AUTHOR,
            )
        if self._every_frame and (found := first_unfit(frames)) is not None:
            index, row, column = found
            place = f"sub-step {substeps[index]}, pixel ({row}, {column})"
            raise _unfit(self._whose, frames[found], place)
        return frames


@contextmanager
def _files(whose: str) -> Iterator[None]:
    """Raise StoreError, with the scene's name, for a file that cannot be read any more."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{whose} could not compute its light: {system_words(error)}",
            hint="the files that the scene names, and their disk",
        ) from error


def _unfit(whose: str, value: Any, place: str) -> UsageError:
    return UsageError(
        f"{whose} gave back light of {value:g} at {place}", possible="finite numbers, 0 or more", hint=AUTHOR
    )
