"""The step ``delay``: delay of the light relative to the charge transfer, for each camera.

The scene does not light a packet of charge before it enters the sensor or after it has left. For a scene at
rest under a pseudo-random code, a line therefore contains only contributions of its own sub-steps 0 to
n + S − 2 (Eq. 1), whatever the scene is. Contributions from other sub-steps measure the offset between light
and charge. Light that is late by δ sub-steps gives every packet a share that belongs to the sub-step before::

    contribution of sub-step m to a line, all columns          z(m) = Σ_u X(m − u),   0 elsewhere
    light late by 0 ≤ δ < 1                                    z′(m) = (1 − δ)·z(m) + δ·z(m + 1)
    light early by 0 ≤ −δ < 1                                  z′(m) = (1 + δ)·z(m) − δ·z(m − 1)

All contributions z′ follow from the lines by linear regression on the code's bits. At the ends they are, with
the light X_0, X_1 on the sensor's first rows and Y_0, Y_1 on its last::

                  z′(−1)      z′(0)           z′(n + S − 2)     z′(n + S − 1)
    late by δ     δ·X_0       X_0 + δ·X_1     (1 − δ)·Y_0       0
    early by δ    0           (1 − δ)·X_0     Y_0 + δ·Y_1       δ·Y_0

A sweep of the trigger's delays determines the light on these rows together with the delay, so that the scene
can be anything that is not dark there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from acquire.codes import ConstantCode, code_from_attrs
from acquire.cores import limit_blas
from acquire.errors import UsageError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.exposure import Exposure
    from acquire.codes import Code
    from acquire.geometry import Geometry

GUARD = 6
"""Sub-steps on each side of a line's own whose contributions are determined, too."""
SPARE = 2.0
"""Least number of lines per unknown contribution; with fewer, noise dominates."""
PASSES = 2
"""Largest offset of the light that the first estimate can find, in passes over the sensor."""
LIT = 0.2
"""Least light on the first and last rows, relative to the mean row, that shows a delay."""
CERTAIN = 8.0
"""Least correlation with a line's sub-steps, in standard deviations of chance correlations."""
AT_SIGHT = 4096
"""Lines used for the first estimate."""
BLOCK = 4096
"""Lines that a regression takes at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Beyond:
    """Contributions to one arm's lines at and beyond the ends of their sub-steps, in units of a row's light.

    Attributes
    ----------
    whole : delay of the light in whole sub-steps; the others are relative to it
    before, first, last, after : contributions of the sub-step before the line's first, of its first and last,
        and of the one after it
    error : standard deviation of each of them
    """

    whole: int
    before: float
    first: float
    last: float
    after: float
    error: float

    @property
    def late_substeps(self) -> float:
        """Rough delay of the light, for edge rows that are as bright as the mean row."""
        return self.whole + self.before - self.after


def beyond(exposure: Exposure) -> tuple[Beyond, Beyond]:
    """Measure both arms' contributions at and beyond the ends of a line's sub-steps.

    Raises UsageError for a code that is not pseudo-random, and for too few or too dark lines.
    """
    code = code_from_attrs(exposure.recording.attrs["code"])
    if isinstance(code, ConstantCode):
        raise UsageError(
            f"{exposure.recording} has steady light, which cannot show a delay",
            possible="a pseudo-random code",
            hint="a run with the rig's code",
        )
    parts = []
    for segment in exposure.blocks():
        sums = segment.lines.sum(axis=2, dtype=np.float64)
        # a line that lacks columns has less light for another reason than its delay
        parts.append(np.where(segment.mask.all(axis=2), sums, np.nan))
    geometry = exposure.recording.geometry_for(1)
    found = []
    for arm, sums in zip(ARMS, np.concatenate(parts, axis=1), strict=True):
        try:
            with limit_blas(1):  # for a few hundred columns, threads would wait longer than they compute
                found.append(beyond_of(sums, code, exposure.first_line, geometry))
        except UsageError as error:
            raise UsageError(
                f"arm {arm} of {exposure.recording}: {error.message}",
                possible=error.possible,
                hint=error.hint,
            ) from error
    return found[0], found[1]


def beyond_of(sums: NDArray[np.float64], code: Code, first_line: int, geometry: Geometry) -> Beyond:
    """Measure one arm's; ``sums`` (line,) of columns begin at ``first_line``, NaN for incomplete lines."""
    S, width = geometry.substeps, geometry.size + geometry.substeps - 1
    lines = np.flatnonzero(np.isfinite(sums))
    needed = int(SPARE * (width + 2 * GUARD + 1))
    if len(lines) < needed:
        raise UsageError(f"{len(lines)} complete lines do not show a delay", possible=f"{needed} or more")
    change = sums[lines] - sums[lines].mean()
    whole = _whole_substeps(code, S * first_line, S * lines, change, width)
    begin = S * first_line - whole - GUARD
    span = width + 2 * GUARD
    bits = code.bits(begin, S * len(sums) + span).astype(np.float64)
    view = np.lib.stride_tricks.sliding_window_view(bits, span)
    parts, errors = _contributions(view, S * lines, change)
    return _ends(parts, errors, whole, geometry)


def _whole_substeps(
    code: Code, first: int, starts: NDArray[np.int64], y: NDArray[np.float64], width: int
) -> int:
    """Return the delay of the light in whole sub-steps, roughly: where lines and code correlate best."""
    reach, y, starts = PASSES * width, y[:AT_SIGHT], starts[:AT_SIGHT]
    bits = code.bits(first - reach, int(starts[-1]) + width + 2 * reach).astype(np.float64)
    view = np.lib.stride_tricks.sliding_window_view(bits, width + 2 * reach)
    along = np.zeros(width + 2 * reach)
    # block by block, because indexing copies a window for every line
    for at in range(0, len(y), BLOCK):
        # bits as ±½, so that chance correlations have mean 0
        along += y[at : at + BLOCK] @ (view[starts[at : at + BLOCK]] - 0.5)
    sums = np.convolve(along, np.ones(width), "valid")
    best = int(sums.argmax())
    # standard deviation of a sum of N·width products of noise with ±½
    chance = 0.5 * float(y.std()) * (len(y) * width) ** 0.5
    if sums[best] < CERTAIN * chance:
        raise UsageError(
            "the lines do not follow the light's code",
            hint="switch the light on, keep the scene at rest; acquire trigger square checks the wires",
        )
    return reach - best


def _contributions(
    view: NDArray[np.float64], starts: NDArray[np.int64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sub-steps' contributions and their errors, by regression on the bits and a constant.

    The constant takes up light that the code does not switch.
    """
    unknown = view.shape[1] + 1
    normal, right = np.zeros((unknown, unknown)), np.zeros(unknown)
    for at in range(0, len(y), BLOCK):
        A = np.hstack([view[starts[at : at + BLOCK]], np.ones((len(y[at : at + BLOCK]), 1))])
        normal += A.T @ A
        right += A.T @ y[at : at + BLOCK]
    try:
        factor = cho_factor(normal)
    except LinAlgError as error:
        raise UsageError(
            "the light's code does not distinguish its sub-steps", possible="a pseudo-random code"
        ) from error
    found = cho_solve(factor, right)
    # the residual without another pass over the lines; rounding may leave it below 0
    variance = max(float(y @ y - right @ found), 0.0) / (len(y) - unknown)
    errors = np.sqrt(variance * np.diag(cho_solve(factor, np.eye(unknown))))
    return found[:-1], errors


def _ends(parts: NDArray[np.float64], errors: NDArray[np.float64], whole: int, geometry: Geometry) -> Beyond:
    """Place the line's own sub-steps where they leave least outside, and return the contributions there."""
    width = geometry.size + geometry.substeps - 1
    # every row is in S of the contributions
    row = float(parts.sum() / (geometry.size * geometry.substeps))
    outside = np.abs(parts).sum() - np.convolve(np.abs(parts), np.ones(width), "valid")
    # away from the ends, because one contribution on either side is needed
    at = 1 + int(outside[1:-1].argmin())
    first, last = parts[at : at + geometry.substeps], parts[at + width - geometry.substeps : at + width]
    # the first S contributions are those of 1, 2, … S rows: S·(S + 1)/2 in all
    if min(first.sum(), last.sum()) < LIT * row * geometry.substeps * (geometry.substeps + 1) / 2:
        raise UsageError(
            "the scene is dark at the sensor's first or last rows, where delays show",
            hint="a bright scene larger than the field, as for the flat",
        )
    before, begin, end, after = (float(parts[k]) / row for k in (at - 1, at, at + width - 1, at + width))
    return Beyond(
        whole=whole + GUARD - at,
        before=before,
        first=begin,
        last=end,
        after=after,
        error=float(np.hypot(errors[at - 1], errors[at + width]) / np.sqrt(2)) / row,
    )
