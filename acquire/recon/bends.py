"""What moves across the picture as one on a path that bends: found in a first video, and followed as a drift.

    x(t, r) = y(t, r − d(t))       d(t) = v·t + Σ cₖ·Pₖ(t), k = 2, 3, …, with Legendre's polynomials Pₖ

Balls fall, bounce and swing. No velocity lets what they show add up, but a path does, and it can be read off
a first video: where each instant matches best what those before it show. That path is then made smooth, and
the one near it found along which the most adds up.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.ndimage import maximum_filter
from scipy.optimize import minimize

from acquire.arrays import host
from acquire.recon.basis import TemporalBasis
from acquire.recon.drift import Waves, displacements, find_drift

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.recon.candidates import Candidate
    from acquire.recon.workbench import Trial

    Path = tuple[float, ...]

ORDERS = (3, 8, 26)
"""Highest polynomials of a path: one that speeds up or falls takes 2 or 3, one that turns back 8, and one
with the corners of something that bounces 26."""
WORTH_BENDING, WORTH_MORE = 1.2, 1.05
"""Least gain of the share that adds up for which a path bends, and for which it takes the higher polynomials.
Where it does bend, the share grows by 1.35 to 2.4, and for text and bodies that cross the field, in whose
errors a path can bend, by 1.02 to 1.12. A splash seems to move on such a path as well: there, the held-out
samples decide."""
CLEAR, FAINT = 0.36, 0.25
"""Share of the changing light that has to add up on a path in whose place there is no straight one, to be
tried at once and after all others. Pendulums have 0.29 to 0.5, but what flickers or deforms 0.2 to 0.5: the
held-out samples decide, and the time that this takes may be missed."""
SHARPEST = 4.0
"""Largest change of the velocity between two instants of a first path, in sides over the range."""
FIRST_SEEN = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Instants, as shares of the range, from which on what moves is looked for: from one that does not show it,
another path is found."""
FITS, NEAR = 12, 0.02
"""Number of fits of a smooth path, and distance in sides up to which an instant counts in full."""
PLACES = 64
"""Number of places along each side in which an instant is looked for."""
PLACED = np.arange(PLACES) / PLACES
QUICKEST = 8.0
"""Largest velocity on a path that is looked for from end to end, in sides over the range."""
STEPS = 60
"""Largest number of steps to the best path."""


def drifting(trial: Trial, adds_up: float = CLEAR) -> Candidate | None:
    """Return a trial's candidate that follows what moves in its video; None if nothing moves as one."""
    count, drift = trial.basis.count, trial.candidate.drift
    basis = TemporalBasis(count, count, trial.bench.problem.arrays)
    instants = host(basis.synthesize(trial.coefficients))
    bent = drift if len(drift) > 2 else None  # a video on such a path shows no velocity
    straight = None if bent else find_drift(instants)
    found = find_bends(instants, straight, bent, adds_up)
    if found is not None:
        return replace(trial.candidate, drift=found, speed_changes=(), rotation=())
    if straight is None:
        return None
    return replace(trial.candidate, drift=straight[:2], speed_changes=straight[2:], rotation=())


def find_bends(
    instants: NDArray[Any], straight: Path | None, bent: Path | None = None, adds_up: float = CLEAR
) -> Path | None:
    """Return the path of what moves in a video (K, n, n), as `drift.displacements` takes it.

    It has to let much more add up than the ``straight`` one, or ``adds_up`` if there is none; None if no
    path does. With one that is ``bent``, it is the best one near that.
    """
    count, waves = len(instants), Waves(instants)
    orders = [each for each in ORDERS if 2 * each < count]
    if len(orders) < 2 or waves.at_rest:
        return bent
    if bent is not None:
        return _again(waves, bent, orders)
    least = adds_up / WORTH_BENDING
    starts: list[tuple[Path, int]] = []
    if straight is not None:
        least = waves.share(displacements(straight[:2], count, *straight[2:]))
        starts.append((straight[:2], orders[0]))
    tracked = [_tracked(waves, int(first * count)) for first in FIRST_SEEN]
    if tracked := [each for each in tracked if waves.share(each) > least]:
        for order in orders[1:]:  # one of each, because finding the best path near it takes most of the time
            smooth = (_smooth(each, order) for each in tracked)
            starts.append((max(smooth, key=lambda path: waves.added(displacements(path, count))), order))
    best: Path | None = None
    for start, order in starts:
        found = _nearby(waves, start, order)
        if _share(waves, found) > WORTH_BENDING * least:
            best = found if best is None else _better(waves, best, found)
    return best


def _again(waves: Waves, bent: Path, orders: list[int]) -> Path:
    """The best path near one that is known, or one with more polynomials near where it leads."""
    near = _nearby(waves, bent, len(bent) // 2)
    if more := [each for each in orders if 2 * each > len(bent)]:
        tracked = _among_all(waves, displacements(near, len(waves.amplitudes)))
        for order in more:
            near = _better(waves, near, _nearby(waves, _smooth(tracked, order), order))
    return near


def _better(waves: Waves, path: Path, more: Path) -> Path:
    """The path with more polynomials, if it is worth them."""
    return more if _share(waves, more) > WORTH_MORE * _share(waves, path) else path


def _share(waves: Waves, path: Path) -> float:
    return waves.share(displacements(path, len(waves.amplitudes)))


def _polynomials(count: int, order: int) -> NDArray[np.float64]:
    """What the coefficients of a path are multiplied by at each instant (K, order)."""
    t = (np.arange(count) + 0.5) / count - 0.5
    return np.column_stack([t, legvander(2 * t, order)[:, 2:]])


def _nearby(waves: Waves, start: Path, order: int) -> Path:
    """The path near ``start``, up to a polynomial, along which the most adds up."""
    first, powers = np.zeros((order, 2)), _polynomials(len(waves.amplitudes), order)
    known = np.reshape(start, (-1, 2))[:order]
    first[: len(known)] = known

    def missed(x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        by = powers @ x.reshape(order, 2)
        return -waves.share(by), -(powers.T @ waves.slope(by)).ravel()

    found = minimize(missed, first.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": STEPS})
    return tuple(map(float, found.x))


def _smooth(tracked: NDArray[np.float64], order: int) -> Path:
    """The smooth path nearest to most of the instants; in what is far off, another thing was seen."""
    count = len(tracked)
    design, weights = np.column_stack([np.ones(count), _polynomials(count, order)]), np.ones((count, 1))
    for _ in range(FITS):
        found = np.linalg.lstsq(design * weights, tracked * weights, rcond=None)[0]
        missed = np.linalg.norm(tracked - design @ found, axis=1, keepdims=True)
        weights = 1 / np.sqrt(np.maximum(missed, NEAR))  # so that distances add up, not their squares
    return tuple(map(float, found[1:].ravel()))


def _tracked(waves: Waves, first: int) -> NDArray[np.float64]:
    """Where what is looked for from the first instant on is at each instant (K, 2)."""
    return _among_all(waves, _seen_from(waves, first))


def _seen_from(waves: Waves, first: int) -> NDArray[np.float64]:
    """Where each instant (K, 2) matches best the sum of those between it and the first."""
    amplitudes, count = waves.amplitudes, len(waves.amplitudes)
    by, match_at = np.zeros((count, 2)), _matching(waves)
    for way in (1, -1):
        seen, step = amplitudes[first].copy(), np.zeros(2)
        for k in range(first + way, count if way > 0 else -1, way):
            expected = by[k - way] + step
            match = match_at(amplitudes[k] * seen.conj())
            down, right = ((PLACED - each + 0.5) % 1 - 0.5 for each in expected)
            near = abs(np.stack(np.meshgrid(down, right, indexing="ij"))).max(axis=0) <= SHARPEST / count
            row, column = np.unravel_index(np.where(near, match, -np.inf).argmax(), match.shape)
            by[k] = expected + np.array([down[row], right[column]])
            step = by[k] - by[k - way]
            seen += amplitudes[k] * waves.turns(by[k])
    return by


def _among_all(waves: Waves, by: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where all instants (K, 2) together match best the sum of the others, which a first path gives.

    An instant that was not recognised led the first path astray, but not this one: of all paths that are not
    too fast, it is the best from end to end (Viterbi).
    """
    count, match_at = len(by), _matching(waves)
    moved = waves.amplitudes * waves.turns(by)
    others = moved.sum(axis=0) - moved
    reach = int(np.ceil(PLACES * QUICKEST / count))
    sums = [match_at(waves.amplitudes[0] * others[0].conj())]
    for k in range(1, count):
        match = match_at(waves.amplitudes[k] * others[k].conj())
        sums.append(match + maximum_filter(sums[-1], size=2 * reach + 1, mode="wrap"))
    near, places = np.arange(-reach, reach + 1), np.zeros((count, 2), int)
    places[-1] = np.unravel_index(sums[-1].argmax(), sums[-1].shape)
    for k in range(count - 2, -1, -1):
        around = (places[k + 1][:, None] + near) % PLACES
        row, column = np.unravel_index(sums[k][np.ix_(*around)].argmax(), (len(near), len(near)))
        places[k] = around[0, row], around[1, column]
    return np.unwrap(places / PLACES, axis=0, period=1.0)


def _matching(waves: Waves) -> Callable[[NDArray[Any]], NDArray[np.float64]]:
    """What turns the products of two instants' waves into how well these match, moved by `PLACED` (…, …)."""
    rows = np.exp(2j * np.pi * PLACED[:, None] * waves.down)
    columns = np.exp(2j * np.pi * PLACED[:, None] * waves.across) * waves.weights
    return lambda product: (rows @ product @ columns.T).real
