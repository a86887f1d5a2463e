"""What moves across the picture at a constant velocity: found in a first video, and followed by a volume.

    x(t, r) = y(t, r − v·t)        y hardly changes; v in sides of the picture over the range

Total variation of a volume counts how far its contents move between two instants, so that a weight that holds
back the noise keeps fast texture from moving. Of y, which moves along, it counts what changes besides. Text
that scrolls, goods on a belt and a body that crosses the field are nearly at rest there.

The velocity need not be known. In the spectrum of a picture, motion turns the phase of each wave in
proportion to time: for the right v the instants add up, and for any other they cancel. That is found in a
first video whose edges are still smeared.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.arrays import host, namespace
from acquire.recon.basis import TemporalBasis

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.recon.workbench import Trial

WAVES = 10
"""Highest waves across the picture that are compared: finer ones are smeared in a first video."""
FASTEST = 1.5
"""Largest velocity that is looked for, in sides of the picture over the range."""
COHERENT = 0.3
"""Share of the changing light that has to add up at one velocity for a trial, which takes a second: bodies
that cross the field and text have 0.35 to 0.8, what deforms or turns 0.1 to 0.28, and lamps 0.1. With what
the mean over time holds, what deforms slowly has as much as bodies, and its velocity is none."""
LEAST_LEFT = 0.1
"""Smallest share of a wave that its mean over time leaves, for which what is left counts in full."""
ROUNDING = 1e-9
"""Share of a video's energy below which its changes are rounding."""


def drift_of(trial: Trial) -> tuple[float, ...]:
    """Return the velocity of what moves in a trial's video, as `Candidate.drift`; () without one."""
    count = trial.basis.count
    instants = TemporalBasis(count, count, trial.bench.problem.arrays).synthesize(trial.coefficients)
    return find_drift(host(instants)) or ()


def find_drift(instants: NDArray[Any]) -> tuple[float, float] | None:
    """Return the velocity (rows, columns) of what moves in a video (K, n, n); None if nothing moves as one.

    In sides of the picture over the video's duration. What never changes does not count.
    """
    count, side, _ = instants.shape
    # Of fewer instants, neighbours might be a whole wave apart, which looks like standing still.
    if count < FASTEST * WAVES:
        return None
    changes = instants - instants.mean(axis=0)
    if np.square(changes).sum() <= ROUNDING * np.square(instants).sum():
        return None
    # Half of a real picture's waves are the other half's conjugates.
    f, g = np.fft.fftfreq(side, 1 / side), np.fft.rfftfreq(side, 1 / side)
    down, across = np.flatnonzero(abs(f) <= WAVES), np.flatnonzero(g <= WAVES)
    twice = np.where(across > 0, 2.0, 1.0)  # so that these count for both
    waves = np.fft.rfft2(changes)[:, down[:, None], across]
    total = max(count * float((np.square(abs(waves)) * twice).sum()), np.finfo(np.float64).tiny)
    t = (np.arange(count) + 0.5) / count - 0.5
    v = np.arange(-FASTEST, FASTEST + 1e-9, 1 / (2 * WAVES))
    turns = 2j * np.pi * t[:, None, None] * v[:, None]  # (instant, velocity, wave)
    by_rows, by_columns = np.exp(turns * f[down]), np.exp(turns * g[across]).transpose(2, 1, 0)
    shares, coherent = np.empty((2, len(v), len(v)))
    for row in range(len(v)):
        back = by_rows[:, row]
        added = by_columns @ (waves * back[:, :, None]).transpose(2, 0, 1)  # (wave, velocity, wave)
        power = np.square(abs(added))
        shares[row] = power.sum(axis=2).T @ twice / total
        # The mean over time, which is subtracted, holds a part of a wave that turns slowly. Without it, the
        # peak is at too fast a velocity.
        left = np.maximum(1 - np.square(abs(by_columns @ back / count)), LEAST_LEFT)
        coherent[row] = (power / left).sum(axis=2).T @ twice / total
    peak = np.unravel_index(int(coherent.argmax()), coherent.shape)
    if shares[peak] < COHERENT:
        return None
    rows, columns = coherent[:, peak[1]], coherent[peak[0]]
    return _refined(v, rows, int(peak[0])), _refined(v, columns, int(peak[1]))


def _refined(v: NDArray[Any], values: NDArray[Any], at: int) -> float:
    """The vertex of the parabola through a largest value and its neighbours."""
    if not 0 < at < len(v) - 1:
        return float(v[at])
    before, peak, after = values[at - 1 : at + 2]
    curvature = before - 2 * peak + after
    shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return float(v[at] + shift * (v[1] - v[0]))


class Path:
    """y of x and back, for ``count`` instants of a video whose pictures have ``side`` pixels each way.

    Pictures wrap around at their edges, and are interpolated by their waves, so that the map is orthonormal:
    the prox of a function of y is that of y, mapped back.
    """

    def __init__(self, drift: tuple[float, ...], count: int, side: int, like: Array) -> None:
        xp = namespace(like)
        t = (np.arange(count) + 0.5) / count - 0.5
        self._turns = [
            xp.asarray(_shifts(side, velocity * side * t), dtype=like.dtype, device=like.device)
            for velocity in drift
        ]

    def follow(self, x: Array) -> Array:
        """Return y (K, n, n)."""
        rows, columns = self._turns
        return namespace(x).permute_dims(rows, (0, 2, 1)) @ x @ columns

    def restore(self, y: Array) -> Array:
        """Return x (K, n, n)."""
        rows, columns = self._turns
        return rows @ y @ namespace(y).permute_dims(columns, (0, 2, 1))


def _shifts(side: int, by: NDArray[Any]) -> NDArray[Any]:
    """Orthonormal matrices (shift, n, n) that move a periodic signal of ``side`` pixels forwards."""
    f = np.fft.fftfreq(side, 1 / side)
    turns = np.exp(-2j * np.pi * by[:, None] * f / side)
    if side % 2 == 0:
        # A real signal's fastest wave has one phase only: it keeps its length and takes the nearer sign.
        turns[:, side // 2] = np.where(turns[:, side // 2].real < 0, -1, 1)
    moved: NDArray[Any] = np.fft.ifft(turns[:, :, None] * np.fft.fft(np.eye(side), axis=0), axis=1).real
    return moved
