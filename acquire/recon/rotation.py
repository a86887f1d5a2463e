"""What turns about a fixed centre: found in a first video, and followed by a volume.

    x(t, r) = y(t, R(−2π·ν·t)·(r − c) + c)        y hardly changes; ν in turns over the range

As for what drifts (`drift`), total variation along the motion costs little, and that of the volume much: a
fan, a wheel or a stirrer is nearly at rest in y. The turn need not be known: in polar coordinates about the
right centre, it turns the phase of the m-th wave around by m·ν, so that for the right ν the instants add up.
Of motion that repeats, the range is one cycle.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_array

from acquire.arrays import host, namespace
from acquire.recon.basis import CyclicBasis, TemporalBasis
from acquire.recon.drift import LEAST_LEFT, ROUNDING, WAVES, moments, refined

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.recon.candidates import Candidate
    from acquire.recon.workbench import Trial

COHERENT = 0.35
"""Share of the changing light that has to add up in one turn for a trial, which takes a second or two. Of a
perfect video, wheels, discs and most fans have 0.55 to 0.74, what deforms up to 0.4, and the rest 0.04 to
0.3."""
FASTEST = 3.0
"""Largest turn that is looked for, in turns over the range or over `CYCLES`."""
FARTHEST, BETWEEN = 0.3, 0.1
"""Largest distance of a centre from the middle of the picture, for each axis, and that of two centres that
are tried, in sides of the picture."""
ANGLES = 64
"""Number of directions about a centre, enough for twice as many waves around as are compared."""
INSTANTS, CYCLES = 36, 3
"""Numbers of instants of a volume, and of cycles of what repeats, that are compared."""


def turning(trial: Trial) -> Candidate | None:
    """Return a trial's candidate that follows what turns in its video or cycle; None if nothing does."""
    basis, arrays = trial.basis, trial.bench.problem.arrays
    if isinstance(basis, CyclicBasis):
        # Within one cycle, a blade that turns to the next one's place also seems to move along a line.
        cycle = CyclicBasis(basis.count, basis.count // 2, basis.count, arrays)
        video = np.tile(host(cycle.synthesize(trial.coefficients)), (CYCLES, 1, 1))
        found = find_rotation(video, steady=True)
        if found is None:
            return None
        return replace(trial.candidate, rotation=(found[0] / CYCLES, *found[1:]), drift=())
    instants = TemporalBasis(INSTANTS, min(basis.count, INSTANTS), arrays)
    found = find_rotation(host(instants.synthesize(trial.coefficients[: instants.count, ...])))
    if found is None:
        return None
    return replace(trial.candidate, rotation=found[:3], speed_changes=found[3:], drift=())


def find_rotation(instants: NDArray[Any], *, steady: bool = False) -> tuple[float, ...] | None:
    """Return the turn of what moves in a video (K, n, n), as `Rotation` takes it; None if nothing turns.

    If the speed changes, and need not be ``steady``, its rise from the mean to the end, relative to the mean,
    follows. What never changes does not count.
    """
    changes = instants - instants.mean(axis=0)
    if np.square(changes).sum() <= ROUNDING * np.square(instants).sum():
        return None
    changes, count = _reduced(changes), len(changes)
    turns = np.arange(-FASTEST, FASTEST + 1e-9, 1 / (2 * WAVES))
    waves_of = _waves_of(turns, count)
    centres = np.arange(-FARTHEST, FARTHEST + 1e-9, BETWEEN)
    start = max(
        (float(share.max()), float(turns[share.argmax()]), row, column)
        for row in centres
        for column in centres
        for share in [_coherent(changes, *waves_of, row, column)]
    )[1:]

    def share(x: NDArray[np.float64]) -> float:
        return float(_coherent(changes, *_waves_of(x[:1], count, x[3]), x[1], x[2])[0])

    steps = np.array([1 / (4 * WAVES), BETWEEN / 2, BETWEEN / 2])
    found = refined(share, np.array(start), steps, steady=steady)
    # What passes far from the middle seems to turn about a centre that is farther than any that is tried.
    if share(np.array([*found, 0.0][:4])) < COHERENT or max(map(abs, found[1:3])) > FARTHEST:
        return None
    return found


def _reduced(video: NDArray[Any]) -> NDArray[Any]:
    """A video in as few pixels as its lowest waves take, the middle of the picture where it was."""
    side, fewer = video.shape[1], 2 * WAVES + 1
    if side <= fewer:
        return video
    waves = np.arange(WAVES + 1)
    middle = np.exp(1j * np.pi * waves * (1 / fewer - 1 / side))
    for _ in ("rows", "columns"):
        spectrum = np.fft.rfft(video, axis=1)[:, waves] * middle[:, None]
        video = np.fft.irfft(spectrum, fewer, axis=1).transpose(0, 2, 1) * (fewer / side)
    return video


def _waves_of(turns: NDArray[Any], count: int, rise: float = 0.0) -> tuple[NDArray[Any], NDArray[Any]]:
    """What makes the waves (instant, turn, wave) of each of ``turns`` stand still, and their energies.

    The mean over time, which is subtracted, holds a part of a wave that turns slowly.
    """
    t, m = moments(count, rise), np.arange(1, WAVES + 1)
    back = np.exp(2j * np.pi * t[:, None, None] * turns[:, None] * m)
    return back, count * np.maximum(1 - np.square(np.abs(back.mean(axis=0))), LEAST_LEFT)


def _coherent(
    changes: NDArray[Any], back: NDArray[Any], energy: NDArray[Any], row: float, column: float
) -> NDArray[np.float64]:
    """The share of the changing light that adds up about a centre for each turn of `_waves_of`."""
    count, side, _ = changes.shape
    phi = 2 * np.pi * np.arange(ANGLES) / ANGLES
    radii = np.arange(0.5, side * (0.5 + FARTHEST))
    y = (row + 0.5) * side - 0.5 + radii[:, None] * np.sin(phi)
    x = (column + 0.5) * side - 0.5 + radii[:, None] * np.cos(phi)
    polar = (_interpolation(y.ravel(), x.ravel(), side) @ changes.reshape(count, -1).T).T
    polar = polar.reshape(count, len(radii), ANGLES)
    waves = np.fft.rfft(polar, axis=2)[:, :, 1 : WAVES + 1] / ANGLES
    added = np.matmul(back.transpose(2, 1, 0), waves.transpose(2, 0, 1))  # (wave, turn, radius)
    # Each wave counts twice, for its conjugate, and each radius by the area of its ring.
    rings = (added.real**2 + added.imag**2) @ (4 * np.pi * radii)
    power = np.sum(rings / energy.T, axis=0)
    return np.asarray(power / np.square(changes).sum(), np.float64)


def _interpolation(y: NDArray[Any], x: NDArray[Any], side: int) -> csr_array:
    """The matrix that interpolates a picture (side, side) between its pixels; it is 0 outside."""
    rows, columns = np.floor(y).astype(int), np.floor(x).astype(int)
    corners, weights = [], []
    for down in (0, 1):
        for right in (0, 1):
            at = (rows + down, columns + right)
            inside = (at[0] >= 0) & (at[0] < side) & (at[1] >= 0) & (at[1] < side)
            weights.append(inside * (1 - abs(y - at[0])) * (1 - abs(x - at[1])))
            corners.append(np.where(inside, at[0] * side + at[1], 0))
    points = np.tile(np.arange(len(y)), 4)
    return csr_array((np.concatenate(weights), (points, np.concatenate(corners))), (len(y), side * side))


class Rotation:
    """y of x and back, for ``count`` instants of a video whose pictures have ``side`` pixels each way.

    ``rotation`` is (turns over the range, row, column of the centre in sides from the middle of the picture).
    Quarter turns are exact, and what remains is three shears. Their lines wrap around at the edges, and are
    interpolated by their waves, so that the map is orthonormal, as in `drift.Path`.
    """

    def __init__(
        self, rotation: tuple[float, ...], count: int, side: int, like: Array, rise: float = 0.0
    ) -> None:
        xp = namespace(like)
        turns, row, column = rotation
        angle = 2 * np.pi * turns * moments(count, rise)
        quarters = np.rint(angle / (np.pi / 2))
        rest = angle - quarters * (np.pi / 2)
        y, x = (np.arange(side) - (side - 1) / 2 - centre * side for centre in (row, column))
        # Quarter turns are made about the middle of the picture, which moves the centre by this much.
        cosine, sine = np.rint(np.cos(quarters * np.pi / 2)), np.rint(np.sin(quarters * np.pi / 2))
        down = side * (row - (sine * column + cosine * row))
        right = side * (column - (cosine * column - sine * row))
        shear = -np.tan(rest / 2)[:, None]
        shifts = (
            shear * (y + down[:, None]) + right[:, None],
            np.sin(rest)[:, None] * x + down[:, None],
            shear * y,
        )
        complex_type = xp.complex64 if like.dtype == xp.float32 else xp.complex128
        self._turns = [
            xp.asarray(_phases(each, side), dtype=complex_type, device=like.device) for each in shifts
        ]
        self._quarters = [
            xp.asarray((quarters % 4 == each)[:, None, None], device=like.device) for each in range(4)
        ]

    def follow(self, x: Array) -> Array:
        """Return y (K, n, n)."""
        xp = namespace(x)
        first, second, third = (xp.conj(each) for each in self._turns)
        x = _transposed(_moved(_transposed(_moved(x, third)), second))
        return self._turned(_moved(x, first), backwards=True)

    def restore(self, y: Array) -> Array:
        """Return x (K, n, n)."""
        first, second, third = self._turns
        x = _moved(self._turned(y, backwards=False), first)
        return _moved(_transposed(_moved(_transposed(x), second)), third)

    def _turned(self, x: Array, *, backwards: bool) -> Array:
        xp, (_, once, twice, thrice) = namespace(x), self._quarters
        if backwards:
            once, thrice = thrice, once
        other = _transposed(x)
        turned = xp.where(once, xp.flip(other, axis=2), x)
        turned = xp.where(twice, xp.flip(x, axis=(1, 2)), turned)
        return xp.where(thrice, xp.flip(other, axis=1), turned)


def _phases(shifts: NDArray[Any], side: int) -> NDArray[np.complex128]:
    """Factors of the waves (instant, line, wave) of lines that move by ``shifts`` pixels (instant, line)."""
    phases = np.exp(-2j * np.pi * shifts[:, :, None] * np.arange(side // 2 + 1) / side)
    if side % 2 == 0:
        # A real signal's fastest wave has one phase only: it keeps its length and takes the nearer sign.
        phases[:, :, -1] = np.where(phases[:, :, -1].real < 0, -1, 1)
    return phases


def _moved(x: Array, phases: Array) -> Array:
    xp = namespace(x)
    return xp.fft.irfft(xp.fft.rfft(x, axis=2) * phases, n=x.shape[2], axis=2)


def _transposed(x: Array) -> Array:
    return namespace(x).permute_dims(x, (0, 2, 1))
