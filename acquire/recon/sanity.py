"""Sanity checks of lines: stuck arms, light that does not follow the code, too little light.

Levels are measured under the hypothesis that explains the lines best, in units of the scene, with standard
errors.
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
    from acquire.recon.hypotheses import Hypothesis, LineModel

    Floats = NDArray[np.float64]

SIGNIFICANT = 5.0
"""Standard errors beyond which a constant light is significant."""
CONSTANT_SHARE, CONSTANT_ERROR = 0.03, 0.012
"""Smallest constant light, relative to an arm's mean, that is reported, since less costs little; and the
largest standard error for which it is, since a scene that changes smoothly looks much like constant light."""
FEW_ELECTRONS = 100.0
"""Smallest (mean light / noise)² of a sample, which is its number of electrons if all noise is shot noise."""
STUCK_SHARE = 0.5
"""Share of the lit columns that are the same in every line, above which an arm counts as stuck."""
NOISE_STEPS = (0.1, 0.18, 0.32, 0.56, 1.0, 1.8, 3.2, 5.6, 10.0)
"""Factors of the prior's noise that are tried: a decade either way, in quarters."""


@dataclass(frozen=True, slots=True)
class Suspicion:
    """An anomaly: ``kind`` for programs, ``words`` for people."""

    kind: str
    words: str


def unusable(segment: Segment) -> list[Suspicion]:
    """Find what makes lines unusable: no samples, stuck arms, a constant code."""
    found = []
    samples = segment.samples(np.float64)
    for arm, lines, mask in zip("ab", samples, segment.mask, strict=True):
        if not mask.any():
            found.append(Suspicion("no_samples", f"arm {arm} has no usable sample"))
            continue
        known = np.where(mask, lines, np.nan)
        seen = np.isfinite(known).any(0)
        # Columns without a usable sample have neither: numpy warns of them.
        lowest, highest = np.nanmin(known[:, seen], axis=0), np.nanmax(known[:, seen], axis=0)
        # A single line cannot change, and darkness does not.
        if segment.geometry.lines == 1 or not highest.any():
            continue
        still = lowest == highest
        # A constant column at the lowest level may be dark, and is no evidence.
        lit = ~still | (highest > lowest.min())
        share = 1.0 if still.all() else float(still[lit].mean())
        if share > STUCK_SHARE:
            words = f"arm {arm} is stuck: {share:.0%} of its lit columns are the same in every line"
            found.append(Suspicion("stuck", words))
    if segment.code.min() == segment.code.max():
        words = f"the code is {int(segment.code[0])} throughout: lines cannot be compared with it"
        found.append(Suspicion("constant_code", words))
    return found


def dark(segment: Segment) -> list[Suspicion]:
    """Find arms that saw no light at all: none of their usable samples is above the black level."""
    words = "no sample is above its black level, so that no light reached it, or the black level is too high"
    return [
        Suspicion("dark", f"arm {arm} is dark: {words}")
        for arm, lines, mask in zip("ab", segment.samples(np.float64), segment.mask, strict=True)
        if mask.any() and lines[mask].max() <= 0
    ]


def black_level_off(segment: Segment) -> list[Suspicion]:
    """Find arms whose unlit columns share one constant value that is not 0, as it should be."""
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
                f"{still.sum()} columns of arm {arm} that see no light are at {lowest:.3g}, "
                f"{abs(lowest / mean):.0%} of the mean light: the black level is too "
                f"{'low' if lowest > 0 else 'high'}, or some light does not follow the code"
            )
            found.append(Suspicion("black_level", words))
    return found


def suspicions(model: LineModel, hypothesis: Hypothesis) -> list[Suspicion]:
    """Find a wrong black level, ambient light and too little light."""
    views = [model.view(hypothesis, arm) for arm in (0, 1)]
    found = []
    for name, lines, view in zip("ab", model.arms, views, strict=True):
        mean = float(lines.mean())
        found += _constant(name, lines, view.model, mean)
        found += _little_light(name, lines, view.model, mean)
    return found


def _constant(name: str, lines: Floats, model: Model, mean: float) -> list[Suspicion]:
    if mean < 0:
        words = f"arm {name} is darker than its black level on average: the black level is too high"
        return [Suspicion("black_level", words)]
    value, error = model.constant(lines)
    if error > CONSTANT_ERROR * mean or abs(value) < max(SIGNIFICANT * error, CONSTANT_SHARE * mean):
        return []
    share = f"{abs(value) / mean:.0%} ± {error / mean:.0%}"
    if value < 0:
        words = f"arm {name} lacks {share} of its mean light in every sample: the black level is too high"
    else:
        words = (
            f"{share} of arm {name}'s mean light does not follow the code: there is ambient light, or the "
            "black level is too low"
        )
    return [Suspicion("black_level", words)]


def _little_light(name: str, lines: Floats, model: Model, mean: float) -> list[Suspicion]:
    modes = model.modes(lines)
    # The prior's noise is a power of ten; electrons need it more precisely.
    noisy = max(
        (model.with_noise(model.prior.noise * step) for step in NOISE_STEPS),
        key=lambda each: each.evidence(modes),
    )
    sigma = float(np.sqrt(noisy.fit(lines).scale * noisy.prior.noise))
    electrons = (max(mean, 0) / max(sigma, 1e-30)) ** 2
    if electrons >= FEW_ELECTRONS:
        return []
    words = (
        f"arm {name} has too little light: its noise is {sigma / max(mean, 1e-30):.0%} of its mean, as with "
        f"{electrons:.0f} electrons per sample"
    )
    return [Suspicion("little_light", words)]
