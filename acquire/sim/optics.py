"""Scenes as seen through optics, fibres and coarser sensors; separable scenes stay separable."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.sim.scene import MaskScene, Scene, SeparableScene, frames_at

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.fibre import Fibre, Tile

    Image = Callable[[NDArray[np.float32]], NDArray[np.float32]]


def mapped(scene: Scene, image: Image) -> Scene:
    """Return the scene with a linear map applied to its frames (k, n, n)."""
    return _MappedMasks(scene, image) if isinstance(scene, SeparableScene) else _MappedFrames(scene, image)


def binned(scene: Scene, factor: int) -> Scene:
    """Return the sums of light over sub-steps and pixels that are ``factor`` times longer and wider."""
    return _BinnedMasks(scene, factor) if isinstance(scene, SeparableScene) else _BinnedFrames(scene, factor)


def laid_out(scene: Scene, fibre: Fibre, arm: str) -> Scene:
    """Return the middle of a square scene as a fibre lays it out over the width of an arm's sensor."""
    rows, columns = fibre.field()

    def image(frames: NDArray[np.float32]) -> NDArray[np.float32]:
        return fibre.lay_out(frames[:, rows, columns], arm)

    if isinstance(scene, SeparableScene):
        return _MappedMasks(scene, image)
    # frames of a fibre are wider than they are high; ``size`` is their height
    return _MappedFrames(scene, image, fibre.size)


def tile_view(scene: Scene, fibre: Fibre, tile: Tile) -> Scene:
    """Return the part of the square scene that a tile behind a fibre shows."""
    row, column = (
        side.start + fibre.size * place
        for side, place in zip(fibre.field(), (tile.row, tile.column), strict=True)
    )
    part = np.s_[:, row : row + fibre.size, column : column + fibre.size]
    if isinstance(scene, SeparableScene):
        return _MappedMasks(scene, lambda masks: masks[part])
    return _MappedFrames(scene, lambda frames: frames[part], fibre.size)


class _MappedMasks(MaskScene):
    def __init__(self, scene: SeparableScene, image: Image) -> None:
        self._scene = scene
        # once: the map is linear and does not change with time
        self.masks = image(scene.masks)

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        return self._scene.intensity(first, count, substep_s)


class _MappedFrames:
    def __init__(self, scene: Scene, image: Image, size: int | None = None) -> None:
        """``size`` is the number of rows of the image, if the map changes it."""
        self.size = scene.size if size is None else size
        self._scene, self._image = scene, image

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        return self._image(frames_at(self._scene, substeps))


class _BinnedMasks(MaskScene):
    """Intensities are means over the sensor's sub-steps; the factor in the masks turns them into sums."""

    def __init__(self, scene: SeparableScene, factor: int) -> None:
        self._scene, self._factor = scene, factor
        self.masks = _sum_pixels(scene.masks, factor) * np.float32(factor)

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        # steps of a given length are counted in seconds, not in sub-steps: they are the same ones
        if substep_s is not None:
            return self._scene.intensity(first, count, substep_s)
        fine = self._scene.intensity(first * self._factor, count * self._factor)
        mean: NDArray[np.float64] = fine.reshape(len(fine), count, self._factor).mean(axis=2)
        return mean


class _BinnedFrames:
    def __init__(self, scene: Scene, factor: int) -> None:
        self.size = scene.size // factor
        self._scene, self._factor = scene, factor

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        # ascending, as `frames_at` demands
        fine = (substeps[:, None] * self._factor + np.arange(self._factor)).ravel()
        frames = _sum_pixels(frames_at(self._scene, fine), self._factor)
        summed: NDArray[np.float32] = frames.reshape(len(substeps), self._factor, self.size, self.size).sum(
            axis=1
        )
        return summed


def _sum_pixels(frames: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    count, size = len(frames), frames.shape[1] // factor
    blocks = frames.reshape(count, size, factor, size, factor)
    summed: NDArray[np.float32] = blocks.sum(axis=(2, 4))
    return summed
