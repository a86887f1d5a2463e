"""What moves across the picture as one: found in a first video, and followed by a volume.

    x(t, r) = y(t, r − v·t)        y hardly changes; v in sides of the picture over the range

Total variation of a volume counts how far its contents move between two instants, so that a weight that holds
back the noise keeps fast texture from moving. Of y, which moves along, it counts what changes besides. Text
that scrolls, goods on a belt and a body that crosses the field are nearly at rest there.

The velocity need not be known. In the spectrum of a picture, motion turns the phase of each wave in
proportion to time: for the right v the instants add up, and for any other they cancel. That is found in a
first video whose edges are still smeared.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import minimize

from acquire.arrays import host, namespace
from acquire.recon.basis import TemporalBasis

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.recon.candidates import Candidate
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
RISE, STEEPEST, WORTH_A_RISE = 0.1, 0.6, 1.01
"""Step of the rise of the speed, relative to its mean; the steepest that is followed; and the least gain of
the share that adds up for which the speed is not constant."""
REFINEMENTS = 120
"""Largest number of steps from the best velocity of the grid to a better one."""
ROUNDING = 1e-9
"""Share of a video's energy below which its changes are rounding."""


def drifting(trial: Trial) -> Candidate | None:
    """Return a trial's candidate that follows what moves in its video; None if nothing moves as one."""
    count = trial.basis.count
    instants = TemporalBasis(count, count, trial.bench.problem.arrays).synthesize(trial.coefficients)
    found = find_drift(host(instants))
    if found is None:
        return None
    return replace(trial.candidate, drift=found[:2], speed_changes=found[2:], rotation=())


def find_drift(instants: NDArray[Any]) -> tuple[float, ...] | None:
    """Return the velocity (rows, columns) of what moves in a video (K, n, n); None if nothing moves as one.

    In sides of the picture over the video's duration. If the speed changes, its rise from the mean to the
    end, relative to the mean, follows. What never changes does not count.
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
    v = np.arange(-FASTEST, FASTEST + 1e-9, 1 / (2 * WAVES))
    turns = 2j * np.pi * moments(count)[:, None, None] * v[:, None]  # (instant, velocity, wave)
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

    def share(x: NDArray[np.float64]) -> float:
        moved = moments(count, x[2])[:, None, None] * (x[0] * f[down][:, None] + x[1] * g[across])
        back = np.exp(2j * np.pi * moved)
        power = np.square(abs((waves * back).sum(axis=0)))
        left = np.maximum(1 - np.square(abs(back.mean(axis=0))), LEAST_LEFT)
        return float(np.sum(power / left @ twice) / total)

    return refined(share, np.array([v[peak[0]], v[peak[1]]]), np.full(2, 1 / (4 * WAVES)))


def moments(count: int, rise: float = 0.0) -> NDArray[np.float64]:
    """How far ``count`` instants have come on a path, which the whole range passes once, from its middle.

    The speed rises from 1 in the middle to 1 + ``rise`` at the end.
    """
    t = (np.arange(count) + 0.5) / count - 0.5
    return np.asarray(t + rise * np.square(t), np.float64)


def refined(
    share: Callable[[NDArray[np.float64]], float],
    start: NDArray[np.float64],
    steps: NDArray[np.float64],
    *,
    steady: bool = False,
) -> tuple[float, ...]:
    """Return the vertex of ``share`` near ``start``, and the rise of the speed if that is worth it.

    ``share`` is a function of the start's unknowns and of the rise, which is 0 if the speed is ``steady``.
    """
    constant = _highest(lambda x: share(np.append(x, 0.0)), start, steps)
    if steady:
        return tuple(map(float, constant))
    first = np.append(constant, 0.0)
    rising = _highest(share, first, np.append(steps, RISE))
    if share(rising) > WORTH_A_RISE * share(first) and abs(rising[-1]) < STEEPEST:
        return tuple(map(float, rising))
    return tuple(map(float, constant))


def _highest(
    share: Callable[[NDArray[np.float64]], float], start: NDArray[np.float64], steps: NDArray[np.float64]
) -> NDArray[np.float64]:
    def missed(x: NDArray[np.float64]) -> float:
        return -share(x)

    found = minimize(
        missed,
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": start + np.vstack([np.zeros(len(start)), np.diag(steps)]),
            "maxfev": REFINEMENTS,
            "xatol": 1e-3,
            "fatol": 1e-4,
        },
    )
    return np.asarray(found.x, np.float64)


class Path:
    """y of x and back, for ``count`` instants of a video whose pictures have ``side`` pixels each way.

    Pictures wrap around at their edges, and are interpolated by their waves, so that the map is orthonormal:
    the prox of a function of y is that of y, mapped back.
    """

    def __init__(
        self, drift: tuple[float, ...], count: int, side: int, like: Array, rise: float = 0.0
    ) -> None:
        xp, t = namespace(like), moments(count, rise)
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
