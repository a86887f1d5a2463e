"""What is wrong with lines whatever their code: arms that stand still, light without a code, little light.

Measured under the hypothesis that explains the lines best, in units of the scene, each with its error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.recon.outliers import FEWEST_LINES, FEWEST_TOGETHER

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.gaussian import Model
    from acquire.recon.hypotheses import Hypothesis, Witness

    Floats = NDArray[np.float64]

SURE = 5.0
"""Standard errors beyond which something is so."""
CONSTANT_SHARE, CONSTANT_ERROR = 0.03, 0.012
"""Of an arm's mean light: less that follows no code costs little, and what is not known as well as this is
not told, since a scene that changes smoothly looks much like it."""
FEW_ELECTRONS = 100.0
"""A sample's mean light over its noise, squared: what shot noise alone would leave of so many electrons."""
STUCK_SHARE = 0.5
NOISE_STEPS = (0.1, 0.18, 0.32, 0.56, 1.0, 1.8, 3.2, 5.6, 10.0)


@dataclass(frozen=True, slots=True)
class Suspicion:
    """``kind`` for programs, ``words`` for people."""

    kind: str
    words: str


def unusable(segment: Segment) -> list[Suspicion]:
    """What leaves nothing to ask: no samples, arms that stand still, no code."""
    found = []
    samples = segment.samples(np.float64)
    for arm, lines, mask in zip("ab", samples, segment.mask, strict=True):
        if not mask.any():
            found.append(Suspicion("no_samples", f"arm {arm} has no sample that can be used"))
            continue
        found += _standing(arm, np.where(mask, lines, np.nan), segment.geometry.lines)
    if segment.code.min() == segment.code.max():
        found.append(
            Suspicion(
                "constant_code",
                f"the code is {int(segment.code[0])} throughout: lines cannot be held against it",
            )
        )
    return found


def _standing(arm: str, lines: Floats, count: int) -> list[Suspicion]:
    """An arm whose lit columns do not change from line to line."""
    seen = np.isfinite(lines).any(0)
    lowest, highest = np.nanmin(lines[:, seen], axis=0), np.nanmax(lines[:, seen], axis=0)
    if count == 1 or not highest.any():
        return []
    still = lowest == highest
    lit = ~still | (highest > lowest.min())
    if still.all() or still[lit].mean() > STUCK_SHARE:
        share = 1.0 if still.all() else float(still[lit].mean())
        words = f"arm {arm} is stuck: {share:.0%} of its lit columns are the same in every line"
        return [Suspicion("stuck", words)]
    return []


def black_level_off(segment: Segment) -> list[Suspicion]:
    """A black level that unlit columns contradict: they stand still together, at what should be 0."""
    found = []
    for arm, lines, mask in zip("ab", segment.samples(np.float64), segment.mask, strict=True):
        whole = mask.all(0)
        if not whole.any() or segment.geometry.lines < FEWEST_LINES:
            continue
        columns = lines[:, whole]
        lowest, mean = float(columns.min()), float(columns.mean())
        still = (columns == lowest).all(0)
        if still.sum() >= FEWEST_TOGETHER and still.mean() < 1 and abs(lowest) > 0.01 * abs(mean):
            words = (
                f"{still.sum()} columns of arm {arm} that see no light stand at {lowest:.3g}, "
                f"{abs(lowest / mean):.0%} of the mean light: the black level is too "
                f"{'low' if lowest > 0 else 'high'}, or light follows no code"
            )
            found.append(Suspicion("black_level", words))
    return found


def suspicions(witness: Witness, hypothesis: Hypothesis) -> list[Suspicion]:
    """Black level, ambient light, too little light, if this is the case."""
    views = [witness.view(hypothesis, arm) for arm in (0, 1)]
    found = []
    for name, lines, view in zip("ab", witness.arms, views, strict=True):
        mean = float(lines.mean())
        found += _constant(name, lines, view.model, mean)
        found += _little_light(name, lines, view.model, mean)
    return found


def _constant(name: str, lines: Floats, model: Model, mean: float) -> list[Suspicion]:
    if mean < 0:
        words = f"arm {name} is darker than its black level on the mean: the black level is too high"
        return [Suspicion("black_level", words)]
    value, error = model.constant(lines)
    if error > CONSTANT_ERROR * mean or abs(value) < max(SURE * error, CONSTANT_SHARE * mean):
        return []
    share = f"{abs(value) / mean:.0%} ± {error / mean:.0%}"
    if value < 0:
        words = f"arm {name} lacks {share} of its mean light in every sample: the black level is too high"
    else:
        words = f"{share} of arm {name}'s mean light follows no code: ambient light, or too low a black level"
    return [Suspicion("black_level", words)]


def _little_light(name: str, lines: Floats, model: Model, mean: float) -> list[Suspicion]:
    modes = model.modes(lines)
    noisy = max(
        (model.with_noise(model.prior.noise * step) for step in NOISE_STEPS),
        key=lambda each: each.evidence(modes),
    )
    sigma = float(np.sqrt(noisy.fit(lines).scale * noisy.prior.noise))
    electrons = (max(mean, 0) / max(sigma, 1e-30)) ** 2
    if electrons >= FEW_ELECTRONS:
        return []
    words = (
        f"arm {name} has too little light: its noise is {sigma / max(mean, 1e-30):.0%} of its mean, as if a "
        f"sample had {electrons:.0f} electrons"
    )
    return [Suspicion("little_light", words)]
