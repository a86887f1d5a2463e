"""First look at a scene of lamps: the slow cosines, and a few about the rhythm of each lamp.

    slow cosines ─▶ some iterations ─▶ cosines that stand out of the residual ─▶ slow cosines and these ─▶ …

A lamp of some thousand hertz needs a hundred cosines or more, nearly all of which hold nothing: they cost the
time of the first look and admit noise, in which patterns are hard to tell from errors. What the slow cosines
leave of the lines shows the lamps. It also shows sidelobes of the code, through which slow light reaches some
fast cosines; given coefficients, these stay dark, whereas a lamp outshines the slow cosines. Where no lamp is
found, nothing is lost: the whole band is searched for and solved in, as for any other scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from acquire.arrays import host
from acquire.recon.admm import Admm
from acquire.recon.band import segment_operator
from acquire.recon.bandwidth import FASTEST_SHARE, FEWEST_COEFFICIENTS, MARGIN
from acquire.recon.basis import LearnedBasis, TemporalBasis, reachable, resized
from acquire.recon.cosines import begin_in_cosines
from acquire.recon.patterns import has_clear_patterns
from acquire.recon.settling import BEYOND_CHANCE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from acquire.arrays import Array, Arrays
    from acquire.recon.estimates import InBand
    from acquire.recon.given import Given

NO_COSINES = np.zeros(0, np.int64)
LOOK_ITERATIONS, LOOKS = 10, 6
"""Number of iterations between two looks at the residual, and the largest number of these."""
RESIDUAL_SIDE = 48
"""Voxels along a side in which the residual is looked at: a lamp covers many, and noise averages out."""
MAY_BE_A_LAMP, AT_ONCE = 5.0, 6
"""Ratio to the median of the cosines not solved for above which one may be a lamp's, and the largest number
that one look adds."""
BESIDE = 2
"""Number of cosines on either side: a span that is no multiple of the lamp's period spreads its light."""
DARK, LAMP = 2.0, 8.0
"""Energy of a cosine, relative to the median of the faster half of the slow ones, below which it is dropped
after a round, and above which it is a lamp's in the end. Lamps reach 2.5 (M = 256) to 30 in a round and
hundreds later; sidelobes of the code mostly less than 2, and at most 27."""
FAINT = 0.02
"""Energy of a lamp, relative to the brightest one's, below which it may be a sidelobe (up to 0.013, rarely
0.03): it does not widen the band, but may still be found in the residual of the patterns."""
DOUBTFUL = 0.1
"""The same up to which the held-out samples have to be predicted worse without it."""


def pursue(
    given: Given,
    iterations: Callable[[InBand, int], Iterator[int]],
    fastest_lamp: Callable[[], int],
    still: Array | None = None,
) -> InBand | None:
    """Look at the scene in the slow cosines and those of its lamps; None if it has none that are faster.

    ``iterations`` yields before each that may run; ``fastest_lamp`` is the number of cosines up to the
    fastest lamp of the lines' covariance, or 0. The look starts from zero, or from the coefficients
    (1, n′, n′) of a ``still``.
    """
    frames = given.video_shape[0]
    fastest = reachable(frames, given.options.temporal_merge, FASTEST_SHARE)
    # As in the search of a band, few cosines have no median that lamps could stand out of.
    if fastest < 2 * FEWEST_COEFFICIENTS:
        return None
    residual_energy = _spectrum(given, fastest)
    lamps, dark = NO_COSINES, np.zeros(fastest, bool)
    sure, told = NO_COSINES, None
    look = _Look.at_start(given, _windows(lamps, fastest), still)
    for made in range(LOOKS):
        for _ in iterations(look.estimate, LOOK_ITERATIONS):
            look.estimate.solver.step()
        light = look.light(lamps)
        dark[lamps[light < DARK]] = True
        lamps, light = lamps[light >= DARK], light[light >= DARK]
        # All that stood out were sidelobes: as soon as they had coefficients, they went dark.
        if made and not len(lamps):
            return None
        sure = lamps[light >= max(LAMP, FAINT * light.max(initial=0))]
        # Asked for once, and only where there are lamps: the covariance takes its time.
        if told is None and len(sure):
            told = _beyond(fastest_lamp(), sure.max(), fastest)
        if made == LOOKS - 1 or (len(sure) and has_clear_patterns(look.estimate)):
            break
        energy = residual_energy(look.estimate.predict())
        # Most of those that are not solved for hold noise alone, and so their median does.
        usual = np.median(np.delete(energy, look.kept))
        ratio = energy / max(usual, np.finfo(np.float64).tiny)
        # Those that are solved for leave nothing, and dark ones have had their turn.
        ratio[look.kept] = ratio[dark] = 0
        found = _peaks(ratio)
        if not made and not len(found):
            return None
        lamps = np.concatenate([lamps, found])
        look = look.moved(_windows(np.concatenate([lamps, NO_COSINES if told is None else told]), fastest))
    if told is not None and len(sure):
        sure = look.needed(sure)
    if told is None or not len(sure):
        return None
    # What is slower than a lamp costs little.
    lamps = np.concatenate([lamps[lamps <= sure.max()], told])
    return look.moved(_windows(lamps, fastest)).estimate


def widened(given: Given, look: InBand, cosine: int) -> InBand:
    """A look like this one that also holds the cosines about another."""
    kept = look.basis.held
    near = _windows(np.array([cosine]), cosine + BESIDE + 1)
    return _Look(given, look, kept).moved(np.union1d(kept, near)).estimate


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """An estimate in the cosines ``kept``."""

    given: Given
    estimate: InBand
    kept: NDArray[np.int64]

    @classmethod
    def at_start(cls, given: Given, kept: NDArray[np.int64], still: Array | None) -> Self:
        basis = _basis(kept, given.video_shape[0], given.problem.arrays)
        start = None if still is None else resized(still, basis)
        return cls(given, begin_in_cosines(given, basis, start), kept)

    def moved(self, wanted: NDArray[np.int64]) -> _Look:
        """The same light in other cosines, as far as these hold it."""
        if np.array_equal(self.kept, wanted):
            return self
        theta, basis = host(self.estimate.solver.theta), self.estimate.basis
        moved = np.zeros((len(wanted), *theta.shape[1:]), theta.dtype)
        _, to, of = np.intersect1d(wanted, self.kept, return_indices=True)
        moved[to] = theta[of]
        start = basis.arrays.asarray(moved)
        other = begin_in_cosines(self.given, _basis(wanted, basis.frames, basis.arrays), start)
        assert isinstance(other.solver, Admm)
        assert isinstance(self.estimate.solver, Admm)
        other.solver.adopt(self.estimate.solver)
        return _Look(self.given, other, wanted)

    def light(self, lamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """The largest energy about each lamp, relative to that of the faster half of the slow cosines."""
        energy = np.square(host(self.estimate.solver.theta), dtype=np.float64).sum((1, 2))
        # The slowest cosines hold the mean of the scene, which would hide any lamp.
        usual = np.median(energy[FEWEST_COEFFICIENTS // 2 : FEWEST_COEFFICIENTS])
        near = [energy[np.abs(self.kept - lamp) <= BESIDE].max() for lamp in lamps]
        relative: NDArray[np.float64] = np.array(near) / max(usual, np.finfo(np.float64).tiny)
        return relative

    def needed(self, lamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of the lamps without which the held-out samples are predicted worse.

        Bright ones are, and without held-out samples all. Light that only a sidelobe of the code has brought
        to a cosine explains the used samples, and no others.
        """
        light, problem = self.light(lamps), self.given.problem
        # The RMS of n samples of noise varies by 1/√(2n) of itself.
        limit = 1 + BEYOND_CHANCE / np.sqrt(2 * max(1, problem.held_out.sum()))
        error = problem.prediction_error(self.estimate.predict())

        def superfluous(lamp: np.int64) -> bool:
            others = (self.kept < FEWEST_COEFFICIENTS) | (np.abs(self.kept - lamp) > BESIDE)
            without = self.moved(self.kept[others]).estimate.predict()
            return bool(problem.prediction_error(without) <= limit * error)

        kept = [
            energy >= DOUBTFUL * light.max() or not superfluous(lamp)
            for lamp, energy in zip(lamps, light, strict=True)
        ]
        return lamps[kept]


def _beyond(last: int, known: int, fastest: int) -> NDArray[np.int64]:
    """Cosines whose windows hold the fastest lamp of the lines' covariance, if that is beyond the known ones.

    It only gives the end of the lamp's peak and, in long segments, that of a part.
    """
    spread = 2 * BESIDE + 1
    if not known + 2 * spread < last <= fastest - BESIDE:
        return NO_COSINES
    return np.array([last - 1 - spread, last - 1])


def _windows(lamps: NDArray[np.int64], fastest: int) -> NDArray[np.int64]:
    """The cosines to solve for, in order."""
    kept = np.zeros(fastest, bool)
    kept[:FEWEST_COEFFICIENTS] = True
    for lamp in lamps:
        kept[lamp - BESIDE : lamp + BESIDE + 1] = True
    return np.flatnonzero(kept)


def _basis(kept: NDArray[np.int64], frames: int, arrays: Arrays) -> LearnedBasis:
    """These of the cosines; the band ends `MARGIN` beyond the fastest, as one that is searched for does."""
    count = min(frames, round(MARGIN * (int(kept[-1]) + 1)))
    return LearnedBasis(TemporalBasis(frames, count, arrays), np.eye(count)[:, kept])


def _peaks(ratio: NDArray[np.float64]) -> NDArray[np.int64]:
    """The cosines that stand out most, at least a window apart."""
    found: list[int] = []
    left = ratio.copy()
    while len(found) < AT_ONCE and left.max() > MAY_BE_A_LAMP:
        highest = int(left.argmax())
        found.append(highest)
        left[max(0, highest - BESIDE) : highest + BESIDE + 1] = 0
    return np.array(found, np.int64)


def _spectrum(given: Given, count: int) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """The energy of what a prediction leaves of the samples, per cosine."""
    segment, problem, temporal_merge = given.segment, given.problem, given.options.temporal_merge
    frames = given.video_shape[0]
    merge = -(-segment.geometry.size // RESIDUAL_SIDE)
    operator = segment_operator(segment, TemporalBasis(frames, count), merge, temporal_merge)

    def energy(predicted: NDArray[np.float64]) -> NDArray[np.float64]:
        left = np.where(problem.weight > 0, problem.samples - predicted, 0).astype(np.float32)
        each: NDArray[np.float64] = np.square(operator.adjoint(left), dtype=np.float64).sum((1, 2))
        return each

    return energy
