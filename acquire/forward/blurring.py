"""The optics' blur in the model: the image of a frame on each arm's sensor, as matrices and their transposes.

The kernel of an axis is that of the effect ``psf``: a Gaussian sampled at whole fine pixels, normalised and
cut off at 4σ. Its parameter is chosen so that the kernel has the measured width, since a narrow sampled
Gaussian has less variance than its parameter says. Beyond the edge the scene continues with its edge values.
Elements are thus not negative and rows sum to 1, a uniform scene is unchanged, and the bound of ‖Λ′‖ holds.
For voxels of N_m > 1 a voxel is held over its block, the kernel is applied, and the mean over each block is
taken; like the Gaussian, this is one matrix for rows and one for columns.

The veil follows: v times the mean of the blurred frame, and 1 − v times the frame. Rows still sum to 1.

If Λ′ is a product of dense factors (`acquire.recon.band`), these absorb the matrices once and nothing is done
per frame. Otherwise frames are multiplied by them. Without a blur there are no matrices.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from acquire.arrays import HOST
from acquire.blur import falling
from acquire.forward.merge import block_bounds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.arrays import Array, Arrays
    from acquire.blur import Blur
    from acquire.geometry import Geometry

CUT_AT = 4.0
"""Half-width of the kernel in σ, the default of `scipy.ndimage.gaussian_filter1d`."""
NARROWEST = 0.2
"""σ of a kernel whose neighbours get 4·10⁻⁶; anything narrower is treated as a point."""


def blurring(
    blur: Blur | None, geometry: Geometry, spatial_merge: int = 1, arrays: Arrays = HOST
) -> Blurring | None:
    """Return the operator of a blur, or None if there is no blur."""
    return None if blur is None else Blurring(blur, geometry.size, spatial_merge, arrays)


class Blurring:
    """The blur of either arm on frames (k, n′, n′) in the scene's rows and columns, in any ``arrays``."""

    def __init__(self, blur: Blur, size: int, spatial_merge: int, arrays: Arrays = HOST) -> None:
        self._pairs = [
            tuple(arrays.asarray(each) for each in pair) for pair in blur_matrices(blur, size, spatial_merge)
        ]
        self._veil, self._xp = blur.veil, arrays.xp
        self._mean = arrays.asarray(mean_weights(size, spatial_merge))

    def forward(self, arm: int, frames: Array) -> Array:
        """Blur and veil frames as arm 0 or 1 does."""
        rows, columns = self._pairs[arm]
        blurred, veil = rows @ frames @ columns.T, self._veil[arm]
        if not veil:
            return blurred
        mean = (blurred @ self._mean) @ self._mean
        return (1 - veil) * blurred + veil * mean[:, None, None]

    def adjoint(self, arm: int, frames: Array) -> Array:
        """Apply the transpose of `forward`."""
        rows, columns = self._pairs[arm]
        if veil := self._veil[arm]:
            total = self._xp.sum(frames, axis=(1, 2))
            weights = self._mean[:, None] * self._mean[None, :]
            frames = (1 - veil) * frames + veil * total[:, None, None] * weights
        return rows.T @ frames @ columns


def mean_weights(size: int, spatial_merge: int = 1) -> NDArray[np.float64]:
    """Return the share (n′,) of each block of voxels in the mean over the field: the last may be smaller."""
    _, lengths = block_bounds(size, spatial_merge)
    return lengths / size


def blur_matrices(
    blur: Blur, size: int, spatial_merge: int = 1
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return for arms A and B the matrices that act on the scene's rows and on its columns, each (n′, n′).

    Arm A's charge moves from row to row of the scene, arm B's from column to column.
    """
    (along_a, across_a), (along_b, across_b) = blur.a, blur.b
    found = []
    for sigmas, shade in (((along_a, across_a), blur.shade_a), ((across_b, along_b), blur.shade_b)):
        rows, columns = (
            blur_matrix(sigma, size, spatial_merge, shade[i : i + 2])
            for sigma, i in zip(sigmas, (0, 2), strict=True)
        )
        found.append((rows, columns))
    return found


@lru_cache(maxsize=32)
def blur_matrix(
    sigma: float, size: int, spatial_merge: int = 1, shade: tuple[float, ...] = (0.0, 0.0)
) -> NDArray[np.float64]:
    """Return the blur of one axis (n′, n′) by a kernel with a standard deviation of ``sigma`` fine pixels.

    ``shade`` is what the lens takes of the light before; see `Blur`.
    """
    weights = kernel(sigma)
    reach = len(weights) // 2
    at = np.arange(size)[:, None]
    fine = np.zeros((size, size))
    for distance, weight in zip(range(-reach, reach + 1), weights, strict=True):
        np.add.at(fine, (at, np.clip(at + distance, 0, size - 1)), weight)
    if any(shade):
        light = falling(shade, (np.arange(size) - (size - 1) / 2) / (size / 2))
        # at most 1, so that the bound of ‖Λ′‖ holds with a lens as without
        fine *= light / light.max()
    if spatial_merge > 1:
        starts, lengths = block_bounds(size, spatial_merge)
        # sums along columns (a voxel is held over them), means along rows: rows of the matrix still sum to 1
        sums = np.add.reduceat(np.add.reduceat(fine, starts, axis=0), starts, axis=1)
        fine = sums / lengths[:, None]
    fine.setflags(write=False)  # the cache hands the same array to everybody
    return fine


def kernel(sigma: float) -> NDArray[np.float64]:
    """Return a Gaussian at whole pixels, of odd length, whose standard deviation is ``sigma``."""
    if sigma**2 <= _variance(_gaussian(NARROWEST)):
        return np.ones(1)
    # brackets the root: at NARROWEST the variance is too small, as just checked, and at sigma + 1 too large
    parameter = brentq(lambda each: _variance(_gaussian(each)) - sigma**2, NARROWEST, sigma + 1, xtol=1e-9)
    return _gaussian(float(parameter))


def _gaussian(sigma: float) -> NDArray[np.float64]:
    # rounded as `gaussian_filter1d` rounds, so that the simulated kernel has the same length
    reach = max(1, int(CUT_AT * sigma + 0.5))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    normalised: NDArray[np.float64] = weights / weights.sum()
    return normalised


def _variance(weights: NDArray[np.float64]) -> float:
    at = np.arange(len(weights)) - len(weights) // 2
    return float((weights * at**2).sum())
