"""The arms' shares of the scene's light, from the lines: beam splitters and gains that differ.

Each arm sees every pixel of the scene once in every sub-step, so that the lines of both arms hold the same
light in total, except at the ends of a range of lines, where part of one arm's light is in the lines before
or after. Neither the code and its position nor the arms' orientation matter. The gains of single columns
cannot be found in this way, because the light of a column depends on the scene. Arms that are not aligned do
not see the same field: a scene that is brighter at one edge of it than at the opposite one contributes to the
difference, and to its uncertainty.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.recon.outliers import outliers
from acquire.recon.sanity import black_level_off

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.lines import Segment

    Floats = NDArray[np.float64]

FEWEST_PASSES = 2
"""Fewest passes of the scene over a sensor: with fewer, the range consists of its ends."""
ENDS = 0.006
"""Standard error that no residual shows: a drift through the whole range remains in the ratio, 0.006 for a
figure that crosses textured ground."""
FIELD = 0.02
"""Standard deviation of arm B's position relative to arm A's if it was not measured, as a share of the
field's side: 4 of 192 fine pixels."""
EDGE = 1 / 8
"""Share of an arm's columns, at either end, that the widest margin covers."""
SURE = 3.0
"""Standard errors from 1 at which a difference is corrected."""
WORTH = 0.02
"""Smallest difference that is corrected: a smaller one costs a reconstruction less than the ends cost the
estimate."""
MOST_MASKED = 0.1


@dataclass(frozen=True, slots=True)
class Balance:
    """Ratio of arm B's light to arm A's, and its standard error."""

    ratio: float
    error: float

    @property
    def clear(self) -> bool:
        """Whether the arms differ significantly, and by enough to matter."""
        return abs(self.ratio - 1) > max(SURE * self.error, WORTH)

    @property
    def words(self) -> str:
        """The balance in words."""
        return f"arm b gets {self.ratio:.3f} ± {self.error:.3f} times the light of arm a"

    @property
    def corrected_words(self) -> str:
        """The balance in words, for lines that were corrected for it."""
        return f"{self.words}, judging by their lines: corrected (`acquire calibrate flat` measures it)"

    def facts(self, *, corrected: bool) -> dict[str, Any]:
        """The balance as JSON."""
        return {**{name: round(value, 5) for name, value in asdict(self).items()}, "corrected": corrected}


def balance_of(segments: Sequence[Segment]) -> Balance | None:
    """Estimate the balance from ranges of one recording; None if that is impossible.

    Let C be the cumulated light of an arm (2, L_R) from the first line of a range to line ℓ. The light that
    one arm has seen and the other has not yet seen is in flight across the sensors: it is bounded, and
    proportional to the light y of a line if the scene is equally bright along the way. Least squares of C_B =
    c + ratio·C_A + κ·y_A, with one c per range, gives the ratio. The residual is correlated over the passage
    of the scene, M lines, which the standard error takes into account. The effect of a displaced field is
    added to it, unless arm B's position is known. Masked samples are replaced by their neighbours, and their
    share is added to the error.
    """
    seen = [each for each in map(_light, segments) if each is not None]
    # A wrong black level would add up line by line, as light does.
    if not seen or any(black_level_off(segment) for segment in segments):
        return None
    known = [np.stack([np.cumsum(light.lines[0]), light.lines[0]], axis=1) for light in seen]
    # Without its mean, each range needs no constant c of its own.
    columns = np.concatenate([each - each.mean(0) for each in known])
    target = np.concatenate([(each := np.cumsum(light.lines[1])) - each.mean() for light in seen])
    scale = np.abs(columns).max(0)
    if not scale.min() > 0:
        return None
    # Cumulated light is many times that of one line; alike in size, the columns are well conditioned.
    normal = columns / scale
    inverse = np.linalg.pinv(normal.T @ normal)
    found = inverse @ normal.T @ target
    ratio = float(found[0] / scale[0])
    if not ratio > 0:
        return None
    in_flight = float(np.mean(np.square(target - normal @ found)))
    by_ends = np.sqrt(inverse[0, 0] * in_flight * segments[0].geometry.stages) / scale[0]
    by_field = FIELD * np.hypot(*np.mean([light.slopes for light in seen], axis=0))
    by_masked = np.mean([light.masked for light in seen])
    relative = np.array([by_ends / ratio, ENDS, by_field, by_masked])
    return Balance(ratio, ratio * float(np.linalg.norm(relative)))


@dataclass(frozen=True, slots=True, eq=False)
class _Light:
    """Light of a range.

    ``lines``: of each arm in each line (2, L_R). ``slopes``: difference between the outermost columns at an
    arm's two ends, relative to its mean; 0 if the arms are aligned. ``masked``: share of masked samples.
    """

    lines: Floats
    slopes: tuple[float, float]
    masked: float


def _light(segment: Segment) -> _Light | None:
    geometry = segment.geometry
    samples, usable = segment.samples(np.float64), segment.mask
    # A spike would remain in the cumulated light of all later lines.
    for bad in outliers(samples, segment.mask).values():
        usable = usable & ~bad
    masked = 1 - float(usable.mean(axis=(1, 2)).min())
    if geometry.lines < FEWEST_PASSES * geometry.stages or masked > MOST_MASKED:
        return None
    arms = []
    columns = np.arange(samples.shape[2])
    for lines, good in zip(samples, usable, strict=True):
        if good.all():
            arms.append(lines)
            continue
        count = good.sum(0)
        seen = np.flatnonzero(count)
        # A column that is masked throughout takes the mean of its neighbours.
        means = np.interp(columns, seen, np.where(good, lines, 0).sum(0)[seen] / count[seen])
        arms.append(np.where(good, lines, means))
    slopes = [0.0, 0.0]
    if segment.alignment is None:
        # This is the steepest mean difference between the outermost columns at either end of an arm.
        for k, arm in enumerate(arms):
            profile = arm.mean(0)
            width = max(1, round(EDGE * len(profile)))
            begin, end = np.cumsum(profile[:width]), np.cumsum(profile[::-1][:width])
            steepest, mean = np.abs((end - begin) / np.arange(1, width + 1)).max(), float(profile.mean())
            slopes[k] = float(steepest) / mean if mean > 0 else 0.0
    return _Light(np.stack([arm.sum(1) for arm in arms]), (slopes[0], slopes[1]), masked)


def divided(segment: Segment, balance: Balance) -> Segment:
    """The segment with responsivities that remove the difference from its `samples`; their mean is unchanged.

    2/(1 + r) and 2r/(1 + r) are a beam splitter's shares of the light, relative to one half.
    """
    ratio = balance.ratio
    shares = np.array([2 / (1 + ratio), 2 * ratio / (1 + ratio)])
    known = np.asarray(segment.responsivity_dn, np.float64)
    # The responsivity is given for each column (arm, column), or as one number for each arm.
    if known.ndim == 2:
        return replace(segment, responsivity_dn=known * shares[:, None], balanced=True)
    a, b = (known * shares).tolist()
    return replace(segment, responsivity_dn=(a, b), balanced=True)
