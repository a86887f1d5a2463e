"""The optics' blur in the model: the image of a frame on each arm's sensor, as matrices and their transposes.

The kernel of an axis is that of the effect ``psf``: a Gaussian sampled at whole fine pixels, normalised and
cut off at 4σ. Its parameter is chosen so that the kernel has the measured width, since a narrow sampled
Gaussian has less variance than its parameter says. Beyond the edge the scene continues with its edge values.
Elements are thus not negative and rows sum to 1, a uniform scene is unchanged, and the bound of ‖Λ′‖ holds.
For voxels of N_m > 1 a voxel is held over its block, the kernel is applied, and the mean over each block is
taken; like the Gaussian, this is one matrix for rows and one for columns.

The veil follows: v times the mean of the blurred frame, and 1 − v times the frame. Rows still sum to 1.

If Λ′ is a product of dense factors (`acquire.recon.band`), these absorb the matrices once and nothing is done
per frame. Otherwise frames are multiplied by them, along their few diagonals that are not 0. Without a blur
there are no matrices.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from scipy.optimize import brentq

from acquire.arrays import HOST
from acquire.blur import falling
from acquire.forward.kernels import blur_frames
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
NARROW = 0.2
"""Diagonals of both axes, relative to the field's side, up to which loops are faster than dense products."""
Band: TypeAlias = "tuple[NDArray[np.int64], NDArray[Any], NDArray[np.int64], NDArray[Any]]"
"""Diagonals and weights of rows, and those of columns; see `band_of`."""


def blurring(
    blur: Blur | None, geometry: Geometry, spatial_merge: int = 1, arrays: Arrays = HOST
) -> Blurring | None:
    """Return the operator of a blur, or None if there is no blur."""
    return None if blur is None else Blurring(blur, geometry.size, spatial_merge, arrays)


class Blurring:
    """The blur of either arm on frames (k, n′, n′) in the scene's rows and columns, in any ``arrays``."""

    def __init__(self, blur: Blur, size: int, spatial_merge: int, arrays: Arrays = HOST) -> None:
        pairs = blur_matrices(blur, size, spatial_merge)
        mean = mean_weights(size, spatial_merge)
        self._pairs = [_Pair(*pair, arrays) for pair in pairs]
        self._veil, self._xp, self._mean = blur.veil, arrays.xp, arrays.asarray(mean)
        # what the veil's transpose multiplies by the sum of a frame
        self._spread = [arrays.asarray(np.outer(mean @ rows, mean @ columns)) for rows, columns in pairs]

    def forward(self, arm: int, frames: Array) -> Array:
        """Blur and veil frames as arm 0 or 1 does."""
        blurred, veil = self._pairs[arm].forward(frames), self._veil[arm]
        if not veil:
            return blurred
        mean = (blurred @ self._mean) @ self._mean
        blurred *= 1 - veil
        blurred += veil * mean[:, None, None]
        return blurred

    def adjoint(self, arm: int, frames: Array) -> Array:
        """Apply the transpose of `forward`."""
        back, veil = self._pairs[arm].adjoint(frames), self._veil[arm]
        if not veil:
            return back
        total = veil * self._xp.sum(frames, axis=(1, 2))
        back *= 1 - veil
        back += total[:, None, None] * self._spread[arm]
        return back


class _Pair:
    """A matrix on the rows of frames and one on their columns, as compiled loops along their diagonals.

    They are bands, outside which all is 0. Wide ones, and those of other libraries, are multiplied as they
    are.
    """

    def __init__(self, rows: NDArray[np.float64], columns: NDArray[np.float64], arrays: Arrays) -> None:
        self._matrices = tuple(arrays.asarray(each) for each in (rows, columns))
        self._bands: tuple[Band, Band] | None = None
        if arrays.compiled:
            both = (*band_of(rows, arrays.dtype), *band_of(columns, arrays.dtype))
            back = (*band_of(rows.T, arrays.dtype), *band_of(columns.T, arrays.dtype))
            if len(both[0]) + len(both[2]) <= NARROW * len(rows):
                self._bands = both, back

    def forward(self, frames: Array) -> Array:
        rows, columns = self._matrices
        return rows @ frames @ columns.T if self._bands is None else _narrow(frames, self._bands[0])

    def adjoint(self, frames: Array) -> Array:
        rows, columns = self._matrices
        return rows.T @ frames @ columns if self._bands is None else _narrow(frames, self._bands[1])


def _narrow(frames: NDArray[Any], band: Band) -> NDArray[Any]:
    frames = np.ascontiguousarray(frames)
    out = np.zeros_like(frames)
    blur_frames(frames, *band, out)
    return out


def band_of(matrix: NDArray[np.float64], dtype: str) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """Return the diagonals that are not 0 as distances from the main one, and their weights by row."""
    n = len(matrix)
    row, column = np.nonzero(matrix)
    distances = np.unique(column - row)
    weights = np.zeros((len(distances), n), dtype)
    weights[np.searchsorted(distances, column - row), row] = matrix[row, column]
    return distances, weights


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
