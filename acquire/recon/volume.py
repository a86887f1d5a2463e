"""Total variation of a video as a volume: a prior for motion, in place of that of coefficient frames.

    TV₃(x) = Σ √( (∂x/∂row)² + (∂x/∂column)² + (μ·∂x/∂t)² )

over as many instants as there are cosines. An edge that moves is one surface in that volume and costs no more
than one at rest, although all its coefficients are large; light that blinks in place costs twice its contrast
in every period. So it suits moving objects, and coefficient frames (`tv.FrameTv`) suit those that blink.
``pace`` is μ: the higher it is, the less a scene may change. Of motion that repeats, the volume is one cycle,
whose end meets its beginning. What drifts across the picture (`drift`) or turns (`rotation`) can be followed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from array_api_compat import is_numpy_array

from acquire.arrays import Arrays, namespace
from acquire.errors import UsageError
from acquire.recon.basis import CyclicBasis, TemporalBasis
from acquire.recon.drift import Path
from acquire.recon.kernels import SMALLEST_WEIGHT, volume_prox, volume_prox_parallel
from acquire.recon.rotation import Rotation
from acquire.recon.tv import ahead, layer

if TYPE_CHECKING:
    from acquire.arrays import Array

PARALLEL_VOXELS = 1 << 20
"""Number of voxels from which two threads are faster than one, even if another program uses a core."""


class VolumeTv:
    """Isotropic 3-D TV of the first K cosines' volume on K instants, as a denoiser of their coefficients.

    If it is ``cyclic``, the coefficients are those of a `CyclicBasis`, and the instants those of one cycle.
    ``drift`` is the path of the volume's contents in sides of the picture over all instants, see
    `drift.displacements`, and ``rotation`` their turn, see `Rotation`, along which changes are counted; () is
    none.
    ``rise`` is that of the speed from its mean to the end, relative to the mean.
    The transform between coefficients and instants is orthonormal, so that the prox of one is the prox of the
    other. ``prox`` is approximate: ``iterations`` of fast gradient projection (Beck and Teboulle, IEEE
    Trans. Image Process. 18, 2419 (2009)) from where the last call ended.
    """

    def __init__(
        self,
        pace: float = 1.0,
        iterations: int = 6,
        *,
        cyclic: bool = False,
        drift: tuple[float, ...] = (),
        rotation: tuple[float, ...] = (),
        rise: float = 0.0,
    ) -> None:
        if not 0 <= pace < math.inf:
            raise UsageError(
                f"a volume's total variation cannot have pace {pace}", possible="a number of at least 0"
            )
        if iterations < 1:
            raise UsageError(f"the TV prox cannot have {iterations} iterations", possible="1 or more")
        self.pace, self.iterations, self.cyclic = pace, iterations, cyclic
        self.drift, self.rotation, self.rise = drift, rotation, rise
        self._dual: Array = None
        self._instants: Array = None
        self._path: Path | Rotation | None = None

    def resume(self, other: VolumeTv) -> None:
        """Start from the dual field of another, whatever its pace, if it also drifts or turns, or neither."""
        if (bool(self.drift), bool(self.rotation)) != (bool(other.drift), bool(other.rotation)):
            return
        self._instants = other._instants
        self._dual = None if other._dual is None else namespace(other._dual).asarray(other._dual, copy=True)

    def prox(self, frames: Array, weight: float | Array) -> Array:
        """argmin_θ ½‖θ − frames‖² + weight·TV₃(Dᵀ·θ) for coefficients (K, row, column); one weight."""
        xp, weight = namespace(frames), one_weight(weight)
        if weight < SMALLEST_WEIGHT:
            return frames
        count = frames.shape[0]
        if self.drift and self._path is None:
            self._path = Path(self.drift, count, frames.shape[1], frames, self.rise)
        if self.rotation and self._path is None:
            self._path = Rotation(self.rotation, count, frames.shape[1], frames, self.rise)
        if self._dual is None:
            self._dual = xp.stack([xp.zeros_like(frames)] * 3)
            # It is computed in float64, so that frames of float64 do not get cosines that are rounded to
            # float32.
            exact = Arrays(dtype="float64")
            matrix = (
                CyclicBasis(count, count // 2, count, exact)
                if self.cyclic
                else TemporalBasis(count, count, exact)
            ).matrix()
            self._instants = xp.asarray(matrix, dtype=frames.dtype, device=frames.device)
        volume = xp.tensordot(self._instants.T, frames, axes=1)
        volume = volume if self._path is None else self._path.follow(volume)
        if is_numpy_array(volume):
            cleaned = np.empty_like(volume)
            clean = volume_prox if volume.size < PARALLEL_VOXELS else volume_prox_parallel
            clean(
                volume,
                weight,
                pace=self.pace,
                cyclic=self.cyclic,
                dual=self._dual,
                iterations=self.iterations,
                out=cleaned,
            )
        else:
            cleaned = self._prox_of_any(volume, weight)
        cleaned = cleaned if self._path is None else self._path.restore(cleaned)
        return xp.tensordot(self._instants, cleaned, axes=1)

    def _prox_of_any(self, volume: Array, weight: float) -> Array:
        """As `kernels.volume_prox`, in operations of the array API standard."""
        xp, scales = namespace(volume), (1.0, 1.0, self.pace)
        # Differences along an axis have a norm of at most 2: 4 + 4 + 4·μ² is the dual's Lipschitz constant.
        step, momentum = 1 / ((8 + 4 * self.pace**2) * weight), 1.0
        dual, leading = self._dual, self._dual
        for _ in range(self.iterations):
            x = volume + weight * self._divergence(leading, scales)
            gradient = [k * ahead(x, axis) for axis, k in _axes(scales)]
            if self.cyclic:
                gradient[-1] = self.pace * (xp.roll(x, -1, axis=0) - x)
            new = leading + step * xp.stack(gradient)
            # Each voxel's three differences together stay in the unit ball, which makes the TV isotropic.
            new = new / xp.maximum(xp.sqrt(xp.sum(new**2, axis=0)), 1)
            following = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
            leading = new + ((momentum - 1) / following) * (new - dual)
            dual, momentum = new, following
        self._dual = dual
        return volume + weight * self._divergence(dual, scales)

    def _divergence(self, dual: Array, scales: tuple[float, float, float]) -> Array:
        """The negative transpose of the scaled differences, for a dual that is 0 at its ends."""
        xp, total = namespace(dual), 0.0
        for index, (axis, scale) in enumerate(_axes(scales)):
            part = dual[index, ...]
            # The last instant of a cycle has a difference, to the first one.
            before = (
                part[layer(axis, -1)] if self.cyclic and axis == 0 else xp.zeros_like(part[layer(axis, 0)])
            )
            total = total + scale * xp.diff(part, axis=axis, prepend=before)
        return total


def one_weight(weight: float | Array) -> float:
    """A weight as a number; it may be an array of one."""
    return weight if isinstance(weight, float) else float(namespace(weight).max(weight))


def _axes(scales: tuple[float, float, float]) -> tuple[tuple[int, float], ...]:
    """Axes of a volume (t, row, column) in the order of the dual's parts, with their scales."""
    return tuple(zip((1, 2, 0), scales, strict=True))
