"""What moves across the picture as one: found in a first video, and followed by a volume.

    x(t, r) = y(t, r − v·t)        y hardly changes; v in sides of the picture over the range
    x(t, r) = y(t, r − d(t))       on a path that bends (`bends`)

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
from numpy.polynomial.legendre import legvander
from scipy.optimize import minimize

from acquire.arrays import namespace

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from acquire.arrays import Array

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
FINELY = 100
"""Number of instants between which the fastest motion on a path is looked for."""
ROUNDING = 1e-9
"""Share of a video's energy below which its changes are rounding."""


def find_drift(instants: NDArray[Any]) -> tuple[float, ...] | None:
    """Return the velocity (rows, columns) of what moves in a video (K, n, n); None if nothing moves as one.

    In sides of the picture over the video's duration. If the speed changes, its rise from the mean to the
    end, relative to the mean, follows. What never changes does not count.
    """
    count = len(instants)
    waves = Waves(instants)
    # Of fewer instants, neighbours might be a whole wave apart, which looks like standing still.
    if count < FASTEST * WAVES or waves.at_rest:
        return None
    v = np.arange(-FASTEST, FASTEST + 1e-9, 1 / (2 * WAVES))
    turns = 2j * np.pi * moments(count)[:, None, None] * v[:, None]  # (instant, velocity, wave)
    by_rows, by_columns = np.exp(turns * waves.down), np.exp(turns * waves.across).transpose(2, 1, 0)
    shares, coherent = np.empty((2, len(v), len(v)))
    for row in range(len(v)):
        back = by_rows[:, row]
        turned = waves.amplitudes * back[:, :, None]
        added = by_columns @ turned.transpose(2, 0, 1)  # (wave, velocity, wave)
        power = np.square(abs(added))
        shares[row] = power.sum(axis=2).T @ waves.weights
        # The mean over time, which is subtracted, holds a part of a wave that turns slowly. Without it, the
        # peak is at too fast a velocity.
        left = np.maximum(1 - np.square(abs(by_columns @ back / count)), LEAST_LEFT)
        coherent[row] = (power / left).sum(axis=2).T @ waves.weights
    peak = np.unravel_index(int(coherent.argmax()), coherent.shape)
    if shares[peak] < COHERENT:
        return None

    def share(x: NDArray[np.float64]) -> float:
        return waves.share(displacements(x[:2], count, x[2]))

    return refined(share, np.array([v[peak[0]], v[peak[1]]]), np.full(2, 1 / (4 * WAVES)))


class Waves:
    """The lowest waves of what changes in a video (K, n, n), which add up if they are moved back on its path.

    ``amplitudes`` (K, down, across) are those of so many waves ``down`` and ``across`` the picture, and
    ``weights`` make a sum over the latter a share of all the changing light.
    """

    def __init__(self, instants: NDArray[Any]) -> None:
        count, side, _ = instants.shape
        changes = instants - instants.mean(axis=0)
        self.at_rest = bool(np.square(changes).sum() <= ROUNDING * np.square(instants).sum())
        # Half of a real picture's waves are the other half's conjugates.
        f, g = np.fft.fftfreq(side, 1 / side), np.fft.rfftfreq(side, 1 / side)
        down, across = np.flatnonzero(abs(f) <= WAVES), np.flatnonzero(g <= WAVES)
        self.down, self.across = f[down], g[across]
        self.amplitudes = np.fft.rfft2(changes)[:, down[:, None], across]
        twice = np.where(across > 0, 2.0, 1.0)  # so that these count for both
        total = count * float((np.square(abs(self.amplitudes)) * twice).sum())
        self.weights = twice / max(total, np.finfo(np.float64).tiny)

    def turns(self, by: NDArray[np.float64]) -> NDArray[np.complex128]:
        """What moves the waves of each instant back by this much (…, 2), in sides of the picture."""
        rows, columns = by[..., :1, None], by[..., 1:, None]
        return np.asarray(np.exp(2j * np.pi * (rows * self.down[:, None] + columns * self.across)))

    def share(self, by: NDArray[np.float64]) -> float:
        """The share of the changing light that adds up if the instants are moved back by this much (K, 2).

        What the mean over time holds of a wave counts as well, since it is part of what moves.
        """
        turns = self.turns(by)
        power = np.square(abs((self.amplitudes * turns).sum(axis=0)))
        left = np.maximum(1 - np.square(abs(turns.mean(axis=0))), LEAST_LEFT)
        return float(np.sum(power / left @ self.weights))

    def added(self, by: NDArray[np.float64]) -> float:
        """The same share without what the mean over time holds.

        This tells the path of a body from one on which everything hardly moves.
        """
        return float(np.sum(np.square(abs((self.amplitudes * self.turns(by)).sum(axis=0))) @ self.weights))

    def slope(self, by: NDArray[np.float64]) -> NDArray[np.float64]:
        """The derivative of `share` by each displacement (K, 2)."""
        turns = self.turns(by)
        moved, mean = self.amplitudes * turns, turns.mean(axis=0)
        added, left = moved.sum(axis=0), 1 - np.square(abs(mean))
        # By the phases of the waves, of which displacements are multiples: of the power, and of what is left.
        of_power = 2 * np.real(1j * moved * added.conj())
        of_left = np.where(left > LEAST_LEFT, -2 * np.real(1j * turns * mean.conj()) / len(by), 0)
        left = np.maximum(left, LEAST_LEFT)
        by_phase = (of_power - of_left * np.square(abs(added)) / left) / left * self.weights
        rows = (by_phase * self.down[:, None]).sum(axis=(1, 2))
        columns = (by_phase * self.across).sum(axis=(1, 2))
        return np.asarray(2 * np.pi * np.stack([rows, columns], axis=1))


def displacements(drift: ArrayLike, count: int, rise: float = 0.0) -> NDArray[np.float64]:
    """How far what drifts has come at each of ``count`` instants (K, 2), in sides of the picture.

    ``drift`` is its velocity (rows, columns) and, for a path that bends, such pairs of coefficients of
    Legendre's polynomials P₂, P₃, … over the range.
    """
    t, pairs = moments(count, rise), np.reshape(np.asarray(drift, np.float64), (-1, 2))
    bends = legvander(2 * moments(count), len(pairs))[:, 2:]
    return np.asarray(np.outer(t, pairs[0]) + bends @ pairs[1:])


def fastest(drift: ArrayLike) -> float:
    """The largest velocity on a path, as `displacements` takes it, in sides of the picture over the range."""
    return float(abs(np.diff(displacements(drift, FINELY), axis=0)).max() * FINELY)


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
        xp, by = namespace(like), displacements(drift, count, rise)
        self._turns = [
            xp.asarray(_shifts(side, each * side), dtype=like.dtype, device=like.device) for each in by.T
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
