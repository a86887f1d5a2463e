"""The arms' shares of the scene's light, from the lines themselves: a beam splitter and gains that differ.

Every pixel of the scene is seen once by each arm in every sub-step, so that the lines of both arms hold the
same light in total but for the ends of a stretch, where for one arm only some of it is in the lines before or
after. Code, its place and the arms' orientation do not matter. The gains of single columns cannot be had in
this way: what a column gets is the scene. Arms that are not aligned do not see the same field: what is
brighter at one edge of it than at the opposite one counts as a difference, and as an uncertainty.
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
"""Times that light crosses a sensor during the stretch: of fewer, the ends are all that there is."""
ENDS = 0.006
"""Standard error that no residual shows: what drifts through a whole stretch stays in the ratio, 0.006 of a
figure that crosses textured ground."""
FIELD = 0.02
"""Standard deviation of arm B's place beside arm A's where nobody has measured it, of the field's side: 4 of
192 fine pixels."""
EDGE = 1 / 8
"""Of an arm's columns, at either end: the widest margin that is looked at."""
SURE = 3.0
"""Standard errors from 1 at which a difference is corrected."""
WORTH = 0.02
"""A difference that costs a reconstruction less than the ends cost the estimate."""
MOST_MASKED = 0.1


@dataclass(frozen=True, slots=True)
class Balance:
    """Arm B's light beside arm A's and its standard error."""

    ratio: float
    error: float

    @property
    def clear(self) -> bool:
        """The arms differ beyond doubt, and by enough to matter."""
        return abs(self.ratio - 1) > max(SURE * self.error, WORTH)

    @property
    def words(self) -> str:
        """For people."""
        return f"arm b gets {self.ratio:.3f} ± {self.error:.3f} times the light of arm a"

    @property
    def corrected_words(self) -> str:
        """For those whose lines it was taken out of."""
        return f"{self.words}, as their lines tell: corrected (`acquire calibrate flat` measures it)"

    def facts(self, *, corrected: bool) -> dict[str, Any]:
        """As JSON."""
        return {**{name: round(value, 5) for name, value in asdict(self).items()}, "corrected": corrected}


def balance_of(segments: Sequence[Segment]) -> Balance | None:
    """Of stretches of one recording; None: cannot tell.

    Let C be the light of an arm (2, L_R) from a stretch's first line to line ℓ. What one arm has seen and the
    other has not yet is in flight across the sensors: it is bounded, and where the scene is as bright on the
    way as at the start, in proportion to the light y of a line. Least squares of C_B = c + ratio·C_A + κ·y_A
    with a c for each stretch gives the ratio; what is left is correlated over the passage of the scene, M
    lines, and so is the error. To it comes what a shift of the field would change, unless arm B's place is
    known. Masked samples are taken to be as their neighbours, and counted as not known.
    """
    seen = [each for each in map(_light, segments) if each is not None]
    if not seen or any(black_level_off(segment) for segment in segments):
        return None
    known = [np.stack([np.cumsum(light.lines[0]), light.lines[0]], axis=1) for light in seen]
    columns = np.concatenate([each - each.mean(0) for each in known])
    target = np.concatenate([(each := np.cumsum(light.lines[1])) - each.mean() for light in seen])
    scale = np.abs(columns).max(0)
    if not scale.min() > 0:
        return None
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
    """``lines``: of each arm in each line (2, L_R). ``slopes``: by how much an arm's outermost columns differ
    between its ends, relative to its mean; 0 where the arms are aligned. ``masked``: share that is not known.
    """

    lines: Floats
    slopes: tuple[float, float]
    masked: float


def _light(segment: Segment) -> _Light | None:
    geometry = segment.geometry
    samples, usable = segment.samples(np.float64), segment.mask
    for bad in outliers(samples, segment.mask).values():
        usable = usable & ~bad
    masked = 1 - float(usable.mean(axis=(1, 2)).min())
    if geometry.lines < FEWEST_PASSES * geometry.stages or masked > MOST_MASKED:
        return None
    arms = [_filled(lines, good) for lines, good in zip(samples, usable, strict=True)]
    a, b = (0.0, 0.0) if segment.alignment is not None else map(_slope, arms)
    return _Light(np.stack([arm.sum(1) for arm in arms]), (a, b), masked)


def _slope(lines: Floats) -> float:
    profile = lines.mean(0)
    begin, end = (np.cumsum(each[: max(1, round(EDGE * len(each)))]) for each in (profile, profile[::-1]))
    steepest, mean = np.abs((end - begin) / np.arange(1, len(end) + 1)).max(), float(profile.mean())
    return float(steepest) / mean if mean > 0 else 0.0


def _filled(lines: Floats, usable: NDArray[np.bool_]) -> Floats:
    """Lines (line, column) with the column's mean where a sample is masked, that of its neighbours where all
    of a column are."""
    if usable.all():
        return lines
    count = usable.sum(0)
    seen = np.flatnonzero(count)
    columns = np.arange(lines.shape[1])
    means = np.interp(columns, seen, np.where(usable, lines, 0).sum(0)[seen] / count[seen])
    return np.where(usable, lines, means)


def divided(segment: Segment, balance: Balance) -> Segment:
    """The segment with responsivities that take the difference out of `samples`; their mean stays.

    2/(1 + r) and 2r/(1 + r) are a beam splitter's shares of the light beside one half.
    """
    ratio = balance.ratio
    shares = np.array([2 / (1 + ratio), 2 * ratio / (1 + ratio)])
    known = np.asarray(segment.responsivity_dn, np.float64)
    if known.ndim == 2:
        return replace(segment, responsivity_dn=known * shares[:, None], balanced=True)
    a, b = (known * shares).tolist()
    return replace(segment, responsivity_dn=(a, b), balanced=True)
