"""What a scene is: light sampled sub-step by sub-step, wherever in time it is asked.

A scene has no beginning: sub-steps before the run (negative) exist too, it shines on and the light's code
alone is dark. Values do not depend on how a stretch of sub-steps is split into calls.

Sources behind masks are *separable*: ``X[t, r, c] = Σ_k intensity[k, t] · mask[k, r, c]``, which the
streaming simulation turns into small matrix products. Scenes compose::

    sources: LedScene, TargetScene, DigitScene (separable)
             SpriteScene, VideoScene, FunctionScene, ArrayScene
    SumScene(parts)      light added          ShutteredScene(scene, shutters)      light cut
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
        """Mean light during sub-steps ``first .. first + count - 1``: (count, row, column) float32."""
        ...


@runtime_checkable
class SparseScene(Scene, Protocol):
    """A scene that need not be computed where the light is off."""

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        """(count, row, column) float32 of any sub-steps, ascending."""
        ...


@runtime_checkable
class SeparableScene(Scene, Protocol):
    """A scene of K fixed masks, each with one intensity."""

    @property
    def masks(self) -> NDArray[np.float32]:
        """(K, row, column), 0 to 1."""
        ...

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        """(K, count): mean over each sub-step, or over steps of another duration counted from 0."""
        ...


def frames_at(scene: Scene, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
    """Frames at some ascending sub-steps, of a scene of any kind."""
    if isinstance(scene, SparseScene):
        return scene.frames_at(substeps)
    if not len(substeps):
        return np.empty((0, scene.size, scene.size), np.float32)
    first = int(substeps[0])
    return scene.frames(first, int(substeps[-1]) - first + 1)[substeps - first]


class SceneModel(SceneBase, ABC):
    """A kind of scene: a model of its keys, and what it shows. Named by an entry point.

    A scene of files also extends `acquire.config.scene.SceneBase.anchored`.
    """

    @abstractmethod
    def build(self, size: int, substep_s: float) -> Scene:
        """What it shows at ``size`` rows and columns, sub-step 0 at the run's begin; without its shutters.

        Raises UsageError for files and values that are no scene.
        """


class MaskScene(ABC):
    """Base of separable scenes; a subclass gives ``masks`` and ``intensity``."""

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
        light = self.intensity(first, last + 1 - first)[:, substeps - first].astype(np.float32)
        frames: NDArray[np.float32] = np.multiply.outer(light[0], self.masks[0])
        for mask, of_time in zip(self.masks[1:], light[1:], strict=True):
            frames += of_time[:, None, None] * mask
        return frames


class ArrayScene:
    """A given video (time, row, column), one frame per sub-step, in a loop.

    The loop runs in both directions from sub-step 0, so that a run of any length has something to see.
    """

    def __init__(self, video: NDArray[Any]) -> None:
        if video.ndim != 3 or 0 in video.shape or video.shape[1] != video.shape[2]:
            raise UsageError(
                f"a scene cannot be a video of shape {video.shape}", possible="(time, n, n), nothing empty"
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
    """The light of several scenes added."""

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
    """Separable scenes added are separable."""

    def __init__(self, parts: Sequence[SeparableScene]) -> None:
        self._parts = parts
        self.masks = np.concatenate([part.masks for part in parts])

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        """(ΣK, count)."""
        return np.concatenate([part.intensity(first, count, substep_s) for part in self._parts])


def add(parts: Sequence[Scene]) -> Scene:
    """The sum of scenes, separable where all of them are."""
    separable = [part for part in parts if isinstance(part, SeparableScene)]
    return SumOfMasks(separable) if len(separable) == len(parts) else SumScene(parts)
