"""Checks from the lines themselves whether the light follows the code, by the forward model of Eq. (1).

Summed over its pixels, line ``l`` of an arm is the code E convolved with the scene's light per row w::

    y(l) = Σ_k E(S·l + k) · h(k)         h = w(row) * (1, … 1)        (S ones: the sub-steps of a line)

The light per row is known from the *other* arm, whose pixels are this arm's rows. So each arm predicts how
the other's lines vary with the code, to the sub-step, for any scene that has contrast; slow changes of the
scene cancel in differences from line to line. The correlation of prediction and measurement at all delays
takes two Fourier transforms. Its peak, in standard deviations of the correlation with a code unrelated to the
light, gives the verdict::

    verified     high at delay 0                      dark          no light, or none that follows a code
    shifted      high at another delay, in sub-steps  wrong_code    light follows another code
    inverted     as high, negative                    unknown       too little contrast, or too much light

Light that saturates the camera no longer adds up. If most of it does, other rows than predicted show the
code, and only its presence at delay 0 is evidence. The same holds for a code that repeats while charge
crosses the sensor: a scene that flickers may look like it at any delay.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.fibre import Fibre

CERTAIN = 14.0
"""Standard deviations from which on a peak is significant: of ten thousand delays, the highest by chance has
six, or nine in a scene that flickers."""
_BETTER = 40.0
"""Smallest significant difference of the squares of two peaks."""
_MUST_SHOW = 2 * CERTAIN
"""Expected peak from which on its absence is significant."""
_FLAT = 3.0
"""Light that varies less than predicted by this factor follows no code."""
_DARK_SHARE = 0.002
"""Share of the camera's range below which there is no light."""
_MOST_SATURATED = 0.5
"""Largest share of the light in saturated samples. Of 384 arms of eight scenes whose light followed the code,
all 156 with shares up to 0.6 were verified, and 48 of the rest: others were called dark, inverted, shifted or
of another code."""
_NEVER_ZERO = 1e-12
"""Keeps quotients finite where nothing varies."""


class Verdict(StrEnum):
    """Result of the check: see the module."""

    UNKNOWN = "unknown"
    VERIFIED = "verified"
    SHIFTED = "shifted"
    INVERTED = "inverted"
    WRONG_CODE = "wrong_code"
    DARK = "dark"

    @property
    def doubtful(self) -> bool:
        """Whether the recorded code is not that of the light."""
        return self not in (Verdict.UNKNOWN, Verdict.VERIFIED)


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Means of consecutive lines of one arm, above the black level, in DN.

    ``energy`` (line): mean of each line, NaN if it has no image; ``profile`` (pixel): mean of each pixel;
    ``saturated``: share of the light in samples at the top of the range.
    """

    energy: NDArray[np.float64]
    profile: NDArray[np.float64]
    saturated: float = 0.0


@dataclass(frozen=True, slots=True)
class ArmVerdict:
    """The verdict on one arm; ``shift``: sub-steps by which its lines are late; ``peak``: see the module."""

    verdict: Verdict
    shift: int = 0
    peak: float = 0.0

    def __str__(self) -> str:
        name = str(self.verdict).replace("_", " ")
        return f"{name} by {self.shift:+d} sub-steps" if self.shift else name


def explain(found: dict[str, ArmVerdict], substeps: int) -> str:
    """Return both verdicts in words and, if the arms differ by whole lines, which one is behind."""
    words = ", ".join(f"arm {arm} {finding}" for arm, finding in found.items())
    a, b = found["a"], found["b"]
    seen = all(finding.verdict in (Verdict.VERIFIED, Verdict.SHIFTED) for finding in (a, b))
    apart = b.shift - a.shift
    if not seen or not apart or apart % substeps:
        return words
    return f"{words}: arm b is {abs(apart) // substeps} lines {'behind' if apart > 0 else 'ahead of'} arm a"


@dataclass(frozen=True, slots=True)
class Judge:
    """Judges the arms of one run.

    Attributes
    ----------
    stages, substeps : M, S
    code : the code of the run
    white_dn : the camera's range
    registration : arm → known delay of its lines in sub-steps, from the position of its image
    fibre : fibre that images several tiles of the scene onto the same rows; None: one scene per line
    """

    stages: int
    substeps: int
    code: Code
    white_dn: int
    registration: dict[str, int]
    fibre: Fibre | None = None

    def look(self, first_line: int, sights: dict[str, Sight]) -> dict[str, ArmVerdict]:
        """Return the verdict on each arm from the same lines of both, from ``first_line`` on."""
        lines = len(sights["a"].energy)
        reach = min(4096, self.substeps * lines // 4)
        span = self.stages * self.substeps + self.substeps - 1
        start = self.substeps * first_line - reach
        bits = self.code.bits(start, self.substeps * lines + span + 2 * reach)
        # Camera B's rows are the scene's columns from right to left, hence the reversal of arm A's profile.
        profiles = {arm: sight.profile for arm, sight in sights.items()}
        if self.fibre is not None:
            profiles = {arm: self.fibre.folded(profile, arm) for arm, profile in profiles.items()}
        others = {"a": profiles["b"], "b": profiles["a"][::-1]}
        found = {
            arm: self._judge(sights[arm], others[arm], bits, reach - self.registration.get(arm, 0))
            for arm in sights
        }
        if not any(finding.verdict.doubtful for finding in found.values()):
            return found
        # Each arm is predicted from the other: it is enough that one of them is saturated.
        saturated = max(sight.saturated for sight in sights.values()) > _MOST_SATURATED
        # The run has no code before line 0. Does what there is repeat while charge crosses the sensor?
        code = bits[reach:]
        if not saturated and not any(np.array_equal(code[n:], code[:-n]) for n in range(1, span)):
            return found
        return {
            arm: finding if finding.verdict is Verdict.VERIFIED else ArmVerdict(Verdict.UNKNOWN)
            for arm, finding in found.items()
        }

    def _judge(
        self, sight: Sight, rows: NDArray[np.float64], bits: NDArray[np.uint8], nominal: int
    ) -> ArmVerdict:
        light, least = float(np.nanmean(sight.energy)), _DARK_SHARE * self.white_dn
        # Darkness is expected if the code leaves the light off for all of these lines.
        dark = ArmVerdict(Verdict.DARK if light < least and bits.any() else Verdict.UNKNOWN)
        # A constant code, or an arm without light, predicts no variation.
        if bits.min() == bits.max() or min(light, rows.mean()) <= 0:
            return dark
        predicted = predict(rows, bits, self.substeps)
        predicted *= light / predicted.mean()
        # Differences from line to line: slow changes of a lamp or the scene drop out, and the code remains.
        steps = predicted[self.substeps :] - predicted[: -self.substeps]
        seen = np.diff(sight.energy)
        known = np.isfinite(seen)
        contrast = float(steps.std() / max(seen[known].std(), _NEVER_ZERO))
        # The correlation of what was seen, one value per line, with the prediction, one per sub-step, at all
        # delays.
        spread = np.zeros(self.substeps * len(seen))
        spread[:: self.substeps] = np.where(known, seen - seen[known].mean(), 0.0)
        size = _transform_size(len(steps))
        product = np.conj(np.fft.rfft(spread, size)) * np.fft.rfft(steps, size)
        raw = np.fft.irfft(product, size)[: len(steps) - len(spread) + 1]
        deviations = raw / max(seen[known].std() * steps.std() * np.sqrt(known.sum()), _NEVER_ZERO)
        found = _read(deviations, nominal, contrast, int(known.sum()))
        # Noise in the dark may correlate with anything, but by chance not at the expected delay.
        is_lit = min(light, rows.mean()) >= least
        return found if is_lit or found.verdict is Verdict.VERIFIED else dark


def predict(rows: NDArray[np.float64], bits: NDArray[np.uint8], substeps: int) -> NDArray[np.float64]:
    """Return the energy of a line that begins at each sub-step of ``bits``, as far as the bits suffice.

    ``rows`` (M,): light per row, in any unit; charge stays in a row for S sub-steps.
    """
    response = np.convolve(np.repeat(rows, substeps), np.ones(substeps))
    size = _transform_size(len(bits))
    product = np.fft.rfft(bits.astype(np.float64), size) * np.conj(np.fft.rfft(response, size))
    energy: NDArray[np.float64] = np.fft.irfft(product, size)[: len(bits) - len(response) + 1]
    return energy


def _read(peaks: NDArray[np.float64], nominal: int, contrast: float, lines: int) -> ArmVerdict:
    """Return the verdict. ``contrast``: predicted variation of the light relative to the measured one."""
    at = int(np.abs(peaks).argmax())
    # Noise alone puts the largest peak anywhere: another delay must explain clearly more than the nominal.
    if peaks[at] ** 2 - peaks[nominal] ** 2 < _BETTER:
        at = nominal
    peak, shift = float(peaks[at]), nominal - at
    if abs(peak) >= CERTAIN:
        straight = Verdict.SHIFTED if shift else Verdict.VERIFIED
        return ArmVerdict(straight if peak > 0 else Verdict.INVERTED, shift, peak)
    if contrast > _FLAT:
        return ArmVerdict(Verdict.DARK, 0, peak)
    certain = min(contrast, 1.0) * np.sqrt(lines) > _MUST_SHOW
    return ArmVerdict(Verdict.WRONG_CODE if certain else Verdict.UNKNOWN, 0, peak)


def _transform_size(length: int) -> int:
    return 1 << (length - 1).bit_length()
