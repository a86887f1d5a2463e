"""Motion that repeats: a wheel, a string, a valve. All of its cycles show the same few phases.

Solved as one cycle, a video has a few harmonics of the period for unknowns instead of all the cosines up to
the fastest, and other lines see each phase in every cycle. The period is looked for in a first look at the
scene, as a comb in its spectrum, and then fitted to the lines: their derivative with respect to the number of
cycles shows which change of it explains most of what is left (Gauss–Newton).

Motors do not turn evenly. The comb is looked for at speeds that rise or fall over the span, too, and the fit
finds the speed as a polynomial of time where this predicts better.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.arrays import host
from acquire.recon.basis import CyclicBasis, share_passed, speed_range

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.recon.basis import Basis
    from acquire.recon.problem import Operator, Problem

FEWEST_CYCLES, FEWEST_HARMONICS, MOST_HARMONICS = 2.0, 2, 12
"""Least number of cycles in the span and of harmonics in the band, since anything could pass for a cycle with
fewer; and the largest number of harmonics that are looked at."""
STEP, LOBE = 0.02, 0.2
"""Distance in cycles of the periods that are tried, by which harmonic 12 moves by a quarter of a cycle; and
half the width of a peak."""
COMB, AS_GOOD = 0.15, 0.75
"""Share of the change beyond chance that a comb has to hold, and share of the best comb's from which a faster
one is preferred: every multiple of a period is a period, too, which leaves more unknowns. Scenes that repeat
have 0.22 to 0.9, others up to 0.14, but for text that scrolls and traffic."""
SHARE_OF_NYQUIST = 0.9
"""Fastest harmonic, relative to half the frame rate, at which every frame would show the same phase."""
ROUNDING = 1e-10
"""Energy of a change, relative to that of the mean, below which it may be rounding."""
NUDGE, FARTHEST = 0.01, 0.1
"""Difference in cycles for the derivative of the lines, and the largest change of one fit."""
TRIED_CHANGES = tuple(round(0.04 * each, 2) for each in range(-10, 11))
"""Rises of the speed from its mean to the end of the span at which a comb is looked for. Ten cycles differ by
0.2 of one between two of them, from where the fit goes on."""
CERTAIN = 1e-6
"""Energy in the lines, relative to that of the best determined combination of speeds, below which one is left
alone."""
SLOWEST, NOTEWORTHY = 0.2, 1.01
"""Lowest speed, relative to the mean, that a fit may reach; least ratio of speeds that a sentence names."""
NEGLIGIBLE = 1e-3
"""Largest share of the change in each course in time that combs leave out: they take a fifth of the time."""


def most_harmonics(period_frames: float, speed_changes: Sequence[float] = ()) -> int:
    """The largest number of harmonics of a mean period that its frames show while it is shortest."""
    return int(SHARE_OF_NYQUIST * period_frames / speed_range(speed_changes)[1] / 2)


def find_period(
    theta: Array, basis: Basis, rises: Sequence[float] = TRIED_CHANGES
) -> tuple[float, tuple[float, ...]] | None:
    """The mean period in frames and the changes of speed of a video of coefficients θ (K, n′, n′).

    Its speed rises by one of ``rises``. Returns None if nothing repeats.
    """
    last = (basis.cosines - 1) / 2  # cosine k of the span is k/2 cycles in it
    tried = np.arange(round(FEWEST_CYCLES / STEP), int(last / FEWEST_HARMONICS / STEP))
    flat = host(theta).reshape(basis.count, -1).astype(np.float64)
    # The first cosine is constant, and no part of the change.
    energies, axes = np.linalg.eigh(flat[1:] @ flat[1:].T)
    change = float(energies.sum())
    if len(tried) < 3 or not change > ROUNDING * np.square(flat[0]).sum():
        return None
    most = energies > NEGLIGIBLE * change
    # These are the courses in which the video changes, at instants that are enough for its cosines.
    courses = basis.matrix(2 * basis.cosines)[1:].T @ (axes[:, most] * energies[most] ** 0.5)
    combs = np.stack([_comb(courses, tried, last, rise) / change for rise in rises])
    chance = 2 * np.minimum(last // (tried * STEP), MOST_HARMONICS) / (basis.count - 1)
    combs = (combs - chance) / np.maximum(1 - chance, STEP)
    best = combs.max(0)
    peaks = 1 + np.flatnonzero((best[1:-1] >= best[:-2]) & (best[1:-1] > best[2:]))
    good = peaks[best[peaks] > max(COMB, AS_GOOD * best[peaks].max(initial=0))]
    if not len(good):
        return None
    near = np.flatnonzero(np.abs(tried - tried[good[-1]]) * STEP <= LOBE)
    which, cycles = np.unravel_index(combs[:, near].argmax(), (len(combs), len(near)))
    period, rise = basis.frames / (STEP * float(tried[near[cycles]])), rises[which]
    return period, (rise,) if rise else ()


def _comb(courses: NDArray[Any], tried: NDArray[np.int64], last: float, rise: float) -> NDArray[np.float64]:
    """Energy that the harmonics of each number of cycles hold of ``courses`` (instants, r).

    ``tried``: the numbers of cycles in units of `STEP`; ``last``: that of the fastest harmonic.
    """
    # float32 takes a third of the time here.
    passed = share_passed(len(courses), (rise,)).astype(np.float32)
    angle = (2 * np.pi * STEP * np.arange(int(last / STEP) + 2, dtype=np.float32))[:, None] * passed
    courses, energy = courses.astype(np.float32), np.zeros(len(angle))
    for wave in (np.cos(angle), np.sin(angle)):
        # A wave's mean square is ½.
        energy += 2 / len(courses) * np.square(wave @ courses).sum(1)
    harmonics, held = np.minimum(last // (tried * STEP), MOST_HARMONICS), np.zeros(len(tried))
    for harmonic in range(1, MOST_HARMONICS + 1):
        within = harmonics >= harmonic
        held[within] += energy[tried[within] * harmonic]
    return held


def better_speed(
    problem: Problem,
    theta: Array,
    basis: CyclicBasis,
    operator: Callable[[CyclicBasis], Operator],
    stride: float,
    order: int,
) -> tuple[float, tuple[float, ...]]:
    """The mean period and the changes of speed with which the same cycle θ explains most of the samples.

    ``operator`` makes that of a basis. The speed gets ``order`` changes, unless it has as many already, and
    moves by ``stride`` times what the fit says.
    """
    missing = (0.0,) * (order - len(basis.speed_changes))
    # In cycles of the span, the mean and the changes.
    speeds = basis.frames / basis.period_frames * np.array([1.0, *basis.speed_changes, *missing])
    # The integral of Pₙ, which is the phase, is (Pₙ₊₁ − Pₙ₋₁)/(2n + 1).
    unit = 2.0 * np.arange(len(speeds)) + 1

    def lines(speeds: NDArray[np.float64]) -> NDArray[np.float64]:
        other = CyclicBasis(
            basis.frames, basis.harmonics, basis.frames / speeds[0], basis.arrays, speeds[1:] / speeds[0]
        )
        return host(problem.masked(operator(other)).forward(theta)).astype(np.float64).ravel()

    slopes = np.stack(
        [(lines(speeds + nudge) - lines(speeds - nudge)) / (2 * NUDGE) for nudge in np.diag(NUDGE * unit)]
    )
    left = host(problem.used_samples).ravel() - lines(speeds)
    # Lines without light have no slope.
    step = stride * np.linalg.lstsq(slopes @ slopes.T, slopes @ left, rcond=CERTAIN)[0]
    step *= FARTHEST / max(abs(step).max(), FARTHEST)
    while speed_range((speeds + unit * step)[1:] / (speeds + unit * step)[0])[0] < SLOWEST:
        step /= 2
    mean, *others = (speeds + unit * step).tolist()
    changes = tuple(each / mean for each in others)
    # Shorter ones have fewer harmonics.
    shortest = 2 * basis.harmonics * speed_range(changes)[1] / SHARE_OF_NYQUIST
    return max(basis.frames / mean, shortest), changes


def describe_cycle(period_frames: float, speed_changes: Sequence[float], frame_ns: float) -> str:
    """Return a sentence about a video of motion that repeats."""
    hz = 1e9 / (period_frames * frame_ns)
    slowest, fastest = (hz * each for each in speed_range(speed_changes))
    changes = fastest > NOTEWORTHY * slowest
    between = f", {slowest:.4g} to {fastest:.4g} Hz as its speed changes," if changes else ""
    return (
        f"the video shows motion that repeats at {hz:.5g} Hz{between} as a single cycle, which predicts the "
        "lines best: what happens only once is in it only if a bandwidth is given (reconstruct(bandwidth=))"
    )
