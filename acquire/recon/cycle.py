"""Motion that repeats: a wheel, a string, a valve. All of its cycles show the same few phases.

Solved as one cycle, a video has a few harmonics of the period for unknowns instead of all the cosines up to
the fastest, and other lines see each phase in every cycle. The period is looked for in a first look at the
scene, as a comb in its spectrum, and then fitted to the lines: their derivative with respect to the number of
cycles shows which change of it explains most of what is left (Gauss–Newton).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.arrays import host
from acquire.recon.basis import CyclicBasis

if TYPE_CHECKING:
    from collections.abc import Callable

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


def most_harmonics(period_frames: float) -> int:
    """The largest number of harmonics of a period that its frames show."""
    return int(SHARE_OF_NYQUIST * period_frames / 2)


def find_period(theta: Array, basis: Basis) -> float | None:
    """The period in frames of a video of coefficients θ (K, n′, n′); None if nothing repeats."""
    last = (basis.cosines - 1) / 2  # cosine k of the span is k/2 cycles in it
    tried = np.arange(round(FEWEST_CYCLES / STEP), int(last / FEWEST_HARMONICS / STEP))
    flat = host(theta).reshape(basis.count, -1).astype(np.float64)
    # The first cosine is constant, and no part of the change.
    gram = flat[1:] @ flat[1:].T
    change = float(np.trace(gram))
    if len(tried) < 3 or not change > ROUNDING * np.square(flat[0]).sum():
        return None
    # This is the energy of the change at numbers of cycles in the span, on a grid of instants.
    rows, cycles = basis.matrix(2 * basis.cosines)[1:].astype(np.float64), np.arange(0, last + STEP, STEP)
    instants, energy = rows.shape[1], np.zeros(len(cycles))
    angle = 2 * np.pi * cycles[:, None] * ((np.arange(instants) + 0.5) / instants - 0.5)
    for wave in (np.cos(angle), np.sin(angle)):
        # A wave's mean square is ½.
        part = wave @ rows.T * (2 / instants) ** 0.5
        energy += (part @ gram * part).sum(1)
    harmonics = np.minimum(last // (tried * STEP), MOST_HARMONICS).astype(int)
    held = np.zeros(len(tried))
    for harmonic in range(1, MOST_HARMONICS + 1):
        within = harmonics >= harmonic
        held[within] += energy[tried[within] * harmonic]
    chance = 2 * harmonics / (basis.count - 1)
    comb = (held / change - chance) / np.maximum(1 - chance, STEP)
    peaks = 1 + np.flatnonzero((comb[1:-1] >= comb[:-2]) & (comb[1:-1] > comb[2:]))
    good = peaks[comb[peaks] > max(COMB, AS_GOOD * comb[peaks].max(initial=0))]
    if not len(good):
        return None
    near = np.flatnonzero(np.abs(tried - tried[good[-1]]) * STEP <= LOBE)
    return basis.frames / (STEP * float(tried[near[comb[near].argmax()]]))


def better_period(
    problem: Problem,
    theta: Array,
    basis: CyclicBasis,
    operator: Callable[[CyclicBasis], Operator],
    stride: float,
) -> float:
    """The period in frames with which the same cycle θ (2H + 1, n′, n′) explains most of the samples.

    ``operator`` makes that of a basis. The number of cycles changes by ``stride`` times what the fit says.
    """
    cycles = basis.frames / basis.period_frames

    def lines(number: float) -> NDArray[np.float64]:
        other = CyclicBasis(basis.frames, basis.harmonics, basis.frames / number, basis.arrays)
        return host(problem.masked(operator(other)).forward(theta)).astype(np.float64)

    slope = (lines(cycles + NUDGE) - lines(cycles - NUDGE)) / (2 * NUDGE)
    left = host(problem.used_samples) - lines(cycles)
    # Lines without light have no slope.
    step = stride * float((slope * left).sum() / max(np.square(slope).sum(), np.finfo(np.float64).tiny))
    fitted = basis.frames / (cycles + min(max(step, -FARTHEST), FARTHEST))
    return max(fitted, 2 * basis.harmonics / SHARE_OF_NYQUIST)  # shorter ones have fewer harmonics


def describe_cycle(period_frames: float, frame_ns: float) -> str:
    """Return a sentence about a video of motion that repeats."""
    period_s = period_frames * frame_ns * 1e-9
    return (
        f"the video shows motion that repeats at {1 / period_s:.5g} Hz as a single cycle, which predicts the "
        "lines best: what happens only once is in it only if a bandwidth is given (reconstruct(bandwidth=))"
    )
