"""The temporal subspace: the first K cosines of the segment's time axis (orthonormal DCT-II).

A video of T frames whose coefficients beyond K are 0 is band-limited to K/(2T) of the frame rate. Working
with K coefficient frames instead of T frames makes the solvers fast. If a scene is a few patterns with a
curve each, a `LearnedBasis` of these curves, which are combinations of the cosines, is smaller still. Motion
that repeats has a `CyclicBasis`, the harmonics of its period.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.polynomial import Legendre
from scipy.fft import dct, idct

from acquire.arrays import HOST
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.arrays import Array, Arrays


def cosine_hz(frame_ns: float, frames: int) -> float:
    """Frequency of the first cosine over ``frames`` frames; K cosines over a span resolve K/(2·span)."""
    return 1e9 / (2 * frame_ns * frames)


def reachable(frames: int, temporal_merge: int, share: float) -> int:
    """Return how many cosines there are up to ``share`` of those of single sub-steps, or all of the frames'.

    Frames of T_m sub-steps are slower, but what they can show is not: their cosines are the first 1/T_m of
    the sub-steps'.
    """
    return min(frames, int(share * temporal_merge * frames))


class Basis(Protocol):
    """Orthonormal rows D (K, T) along the frames' time."""

    @property
    def frames(self) -> int:
        """T, the frames of the video."""
        ...

    @property
    def count(self) -> int:
        """K, the coefficients that the solver holds instead of T frames."""
        ...

    @property
    def cosines(self) -> int:
        """The bandwidth: number of cosines that the rows are combinations of."""
        ...

    @property
    def held(self) -> NDArray[np.int64]:
        """Those of the cosines that any row contains: the video holds no light of the others."""
        ...

    @property
    def arrays(self) -> Arrays:
        """Library and device of coefficients and videos; D itself is on the host, in their dtype."""
        ...

    def matrix(self, grid: int | None = None) -> NDArray[Any]:
        """Return D (K, T), or at ``grid`` equidistant instants, on which the sign of the light is checked."""
        ...

    def spread(self, theta: Array) -> Array:
        """Coefficients of the cosines, (count, …) → (cosines, …)."""
        ...

    def synthesize(self, theta: Array) -> Array:
        """Return the video Dᵀ·θ (T, n′, n′) of coefficients θ (K, n′, n′)."""
        ...

    def analyze(self, video: Array) -> Array:
        """Return D·x (K, n′, n′), the coefficients of the nearest video that the basis holds."""
        ...


class TemporalBasis:
    """D (K, T), orthonormal rows: θ = D·x analyses, x = Dᵀ·θ synthesises, along axis 0.

    It uses fast transforms on the host, and the matrix elsewhere, which is as fast on a GPU.
    """

    def __init__(self, frames: int, count: int, arrays: Arrays = HOST) -> None:
        if not 1 <= count <= frames:
            raise UsageError(
                f"there cannot be {count} temporal coefficients",
                possible=f"1 to {frames} (frames of the segment)",
            )
        self.frames, self.count, self.cosines, self.arrays = frames, count, count, arrays
        self.held = np.arange(count)

    def matrix(self, grid: int | None = None) -> NDArray[Any]:
        """D (K, grid) at ``grid`` ≥ K equidistant instants of the span (default: the frames)."""
        points = grid or self.frames
        if points < self.count:
            raise UsageError(
                f"{points} instants are too few for {self.count} cosines", possible=f"{self.count} or more"
            )
        k = np.arange(self.count)[:, None]
        rows = np.sqrt(2 / points) * np.cos(np.pi * k * (np.arange(points) + 0.5) / points)
        # The constant's mean square is 1, the other cosines' ½.
        rows[0] /= np.sqrt(2)
        matrix: NDArray[Any] = rows.astype(self.arrays.dtype)
        return matrix

    def spread(self, theta: Array) -> Array:
        """Coefficients of the cosines: these themselves."""
        return theta

    def synthesize(self, theta: Array) -> Array:
        """x = Dᵀ·θ: (K, …) → (T, …)."""
        if not self.arrays.compiled:
            return _product(self.arrays, self.matrix().T, theta)
        # `n` pads the coefficients with zeros up to the number of frames; for 64 × 64 × 980, two workers took
        # 8 ms and a product with the matrix 35.
        return self.arrays.asarray(idct(theta, n=self.frames, axis=0, norm="ortho", workers=2))

    def analyze(self, video: Array) -> Array:
        """θ = D·x: (T, …) → (K, …)."""
        if not self.arrays.compiled:
            return _product(self.arrays, self.matrix(), video)
        return self.arrays.asarray(dct(video, axis=0, norm="ortho", workers=2)[: self.count])


class LearnedBasis:
    """R orthonormal combinations of the K rows of a basis: D = curvesᵀ·D_K, with ``curves`` (K, R)."""

    def __init__(self, within: TemporalBasis, curves: NDArray[Any]) -> None:
        self._within, self.curves = within, curves.astype(within.arrays.dtype)
        self.frames, self.count, self.arrays = within.frames, curves.shape[1], within.arrays
        self.cosines, self.held = within.count, np.flatnonzero(curves.any(1))

    def matrix(self, grid: int | None = None) -> NDArray[Any]:
        """D (R, grid)."""
        matrix: NDArray[Any] = self.curves.T @ self._within.matrix(grid)
        return matrix

    def spread(self, theta: Array) -> Array:
        """Coefficients of the cosines: (R, …) → (K, …)."""
        return _product(self.arrays, self.curves, theta)

    def synthesize(self, theta: Array) -> Array:
        """x = Dᵀ·θ: (R, …) → (T, …)."""
        return self._within.synthesize(self.spread(theta))

    def analyze(self, video: Array) -> Array:
        """θ = D·x: (T, …) → (R, …)."""
        return _product(self.arrays, self.curves.T, self._within.analyze(video))


def share_passed(points: int, speed_changes: Sequence[float] = ()) -> NDArray[np.float64]:
    """The share of the span's cycles that has passed at equidistant instants, less its mean over the span.

    It grows by 1 whatever the changes of speed, because P₁, P₂, … have a mean of 0: by −½ … ½ without any.
    """
    way = Legendre([1.0, *speed_changes]).integ() / 2
    way.coef[0] = 0.0  # the constant, which would turn all phases alike
    share: NDArray[np.float64] = way((2 * np.arange(points) + 1) / points - 1)
    return share


def speed_range(speed_changes: Sequence[float]) -> tuple[float, float]:
    """The slowest and the fastest speed in the span, relative to the mean."""
    speed = Legendre([1.0, *speed_changes])(np.linspace(-1, 1, 65))
    return float(speed.min()), float(speed.max())


LEAST_ENERGY = 1e-9
"""Energy of a combination of harmonics, each of which has about 1, below which rounding determines it."""


class CyclicBasis:
    """The constant and H harmonics of a period, a cosine and a sine of each: rows D (2H + 1, T).

    ``speed_changes`` s₁, s₂, … are those of a speed that changes: 1 + Σ sᵢ·Pᵢ(x) of its mean, with Legendre's
    polynomials Pᵢ over the span, x = −1 … 1. ``period_frames`` is then the mean period.

    The mean phase is 0, so that a slightly longer period moves both ends alike. In a
    span that is no whole number of periods the harmonics are slightly oblique: D is the orthonormal set that
    is closest to them (Löwdin, J. Chem. Phys. 18, 365 (1950)).

    Raises UsageError if the period or a speed is not positive, or if there are too few frames for the
    harmonics.
    """

    def __init__(
        self,
        frames: int,
        harmonics: int,
        period_frames: float,
        arrays: Arrays = HOST,
        speed_changes: Sequence[float] = (),
    ) -> None:
        refusal = UsageError(
            f"{frames} frames do not show {harmonics} harmonics of a period of {period_frames:g} frames",
            possible="fewer than half as many harmonics as frames of a period",
        )
        slowest, fastest = speed_range(speed_changes)
        if not (period_frames > 0 and slowest > 0 and harmonics >= 0):
            raise refusal
        if not 2 * harmonics < min(frames, period_frames / fastest):
            raise refusal
        self.frames, self.harmonics, self.arrays = frames, harmonics, arrays
        self.period_frames, self.speed_changes = period_frames, tuple(speed_changes)
        self.count = 2 * harmonics + 1
        # Cosine k of the span is k/2 cycles in it.
        self.cosines = min(frames, math.ceil(2 * harmonics * fastest * frames / period_frames) + 1)
        self.held = np.arange(self.cosines)
        oblique = self._oblique(frames)
        energies, axes = np.linalg.eigh(oblique @ oblique.T)
        # The sine of two frames a cycle is zero in all of them, and nearly so just above.
        if energies[0] < LEAST_ENERGY:
            raise refusal
        self._straighten = axes @ np.diag(energies**-0.5) @ axes.T

    def matrix(self, grid: int | None = None) -> NDArray[Any]:
        """D (2H + 1, grid) at equidistant instants of the span (default: the frames)."""
        matrix: NDArray[Any] = (self._straighten @ self._oblique(grid or self.frames)).astype(
            self.arrays.dtype
        )
        return matrix

    def _oblique(self, points: int) -> NDArray[np.float64]:
        """The harmonics at this many instants, scaled to a norm of about 1."""
        cycles = self.frames / self.period_frames * share_passed(points, self.speed_changes)
        angle = 2 * np.pi * np.arange(1, self.harmonics + 1)[:, None] * cycles
        pairs = np.stack([np.cos(angle), np.sin(angle)], axis=1).reshape(-1, points)
        rows: NDArray[np.float64] = np.concatenate(
            [np.full((1, points), points**-0.5), (2 / points) ** 0.5 * pairs]
        )
        return rows

    def spread(self, theta: Array) -> Array:
        """Coefficients of the cosines: (2H + 1, …) → (cosines, …)."""
        within = TemporalBasis(self.frames, self.cosines, self.arrays).matrix()
        return _product(self.arrays, within @ self.matrix().T, theta)

    def synthesize(self, theta: Array) -> Array:
        """x = Dᵀ·θ: (2H + 1, …) → (T, …)."""
        return _product(self.arrays, self.matrix().T, theta)

    def analyze(self, video: Array) -> Array:
        """θ = D·x: (T, …) → (2H + 1, …)."""
        return _product(self.arrays, self.matrix(), video)


def _product(arrays: Arrays, matrix: NDArray[Any], frames: Array) -> Array:
    """Product of a ``matrix`` on the host with the first axis of ``frames``."""
    return arrays.xp.tensordot(arrays.asarray(matrix), frames, axes=1)


def resized(theta: Array, basis: Basis) -> Array:
    """Coefficients cut or zero-padded to the number of cosines of ``basis``."""
    # The first cosines are the same whatever their number, so that coefficients keep their meaning.
    xp, kept = basis.arrays.xp, theta[: min(basis.count, theta.shape[0]), ...]
    missing = basis.arrays.zeros((basis.count - kept.shape[0], *theta.shape[1:]))
    return xp.concat([kept, missing])
