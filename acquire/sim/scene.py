"""The scene: light sampled sub-step by sub-step, at any time.

A scene has no beginning: it also has light in the sub-steps before the run (negative), and only the light's
code is dark there. Values do not depend on how a range of sub-steps is split into calls.

Sources behind masks are *separable*: ``X[t, r, c] = Σ_k intensity[k, t] · mask[k, r, c]``, which the
streaming simulation turns into small matrix products. Scenes compose::

    sources: LedScene, TargetScene, DigitScene, StillScene (separable)
             SpriteScene, VideoScene, FunctionScene, ArrayScene
    SumScene(parts)      adds light           ShutteredScene(scene, shutters)      blocks light
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from acquire.config.scene import SceneBase
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


class Scene(Protocol):
    """A square scene of ``size`` rows and columns, as camera A sees it; light in arbitrary units."""

    @property
    def size(self) -> int: ...

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """Return the mean light of sub-steps ``first .. first + count - 1``: (count, row, column).

        The array is a new one, which the caller may change.
        """
        ...


@runtime_checkable
class SparseScene(Scene, Protocol):
    """A scene that need not be computed for sub-steps in which the light is off."""

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the frames of any ascending sub-steps: (count, row, column) float32."""
        ...


@runtime_checkable
class SeparableScene(Scene, Protocol):
    """A scene of K fixed masks, each with one intensity."""

    @property
    def masks(self) -> NDArray[np.float32]:
        """(K, row, column), 0 to 1."""
        ...

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        """Return the mean over each sub-step, or over steps of another length counted from 0: (K, count)."""
        ...


def frames_at(scene: Scene, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the frames of a scene of any kind at ascending sub-steps."""
    if isinstance(scene, SparseScene):
        return scene.frames_at(substeps)
    if not len(substeps):
        return np.empty((0, scene.size, scene.size), np.float32)
    first = int(substeps[0])
    # a scene that cannot be sparse computes the frames between them as well
    return scene.frames(first, int(substeps[-1]) - first + 1)[substeps - first]


class SceneModel(SceneBase, ABC):
    """A kind of scene: the model of its keys, which builds the scene. Named by an entry point.

    A scene that refers to files also overrides `acquire.config.scene.SceneBase.anchored`.
    """

    @abstractmethod
    def build(self, size: int, substep_s: float) -> Scene:
        """Return the scene at ``size`` rows and columns, without its shutters; the run begins at sub-step 0.

        Raises UsageError for files and values that do not make a scene.
        """


class MaskScene(ABC):
    """Base of separable scenes; a subclass provides ``masks`` and ``intensity``."""

    masks: NDArray[np.float32]

    @property
    def size(self) -> int:
        return int(self.masks.shape[1])

    @abstractmethod
    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        """See `SeparableScene`."""

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        first, last = (int(substeps[0]), int(substeps[-1])) if len(substeps) else (0, -1)
        # of all sub-steps between the first and the last: intensities cost little, frames are made of the
        # wanted ones
        light = self.intensity(first, last + 1 - first)[:, substeps - first].astype(np.float32)
        frames: NDArray[np.float32] = np.multiply.outer(light[0], self.masks[0])
        for mask, level in zip(self.masks[1:], light[1:], strict=True):
            frames += level[:, None, None] * mask
        return frames


class ArrayScene:
    """A given video (time, row, column), one frame per sub-step, in a loop.

    The loop extends in both directions from sub-step 0, so that a run of any length is covered.
    """

    def __init__(self, video: NDArray[Any]) -> None:
        if video.ndim != 3 or 0 in video.shape or video.shape[1] != video.shape[2]:
            raise UsageError(
                f"a scene cannot be a video of shape {video.shape}", possible="(time, n, n), not empty"
            )
        self.video = video

    @property
    def size(self) -> int:
        return int(self.video.shape[1])

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        return self.video[substeps % len(self.video)].astype(np.float32)


class SumScene:
    """The sum of the light of several scenes."""

    def __init__(self, parts: Sequence[Scene]) -> None:
        self._parts = parts

    @property
    def size(self) -> int:
        return self._parts[0].size

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        total = frames_at(self._parts[0], substeps)
        for part in self._parts[1:]:
            total = total + frames_at(part, substeps)
        return total


class SumOfMasks(MaskScene):
    """The sum of separable scenes, which is separable."""

    def __init__(self, parts: Sequence[SeparableScene]) -> None:
        self._parts = parts
        self.masks = np.concatenate([part.masks for part in parts])

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        """Return the intensities of all parts: (ΣK, count)."""
        return np.concatenate([part.intensity(first, count, substep_s) for part in self._parts])


def add(parts: Sequence[Scene]) -> Scene:
    """Return the sum of scenes, which is separable if all of them are."""
    separable = [part for part in parts if isinstance(part, SeparableScene)]
    return SumOfMasks(separable) if len(separable) == len(parts) else SumScene(parts)
