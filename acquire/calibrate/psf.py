"""How wide the optics blur either arm's image, from straight sharp edges of a target at rest.

The method of the slanted edge (ISO 12233), as a fit: an arm's image of a target (`still`) is looked at in
small windows, and where one holds nothing but a straight edge, that is

    z(p) = low + step·E(p·ν − d),     E = Φ_σ ∗ box of S·|ν_rows| ∗ box of S·|ν_columns|

with the edge's normal ν: a step, blurred by a Gaussian of variance

    σ² = ν_rows²·σ_along² + ν_columns²·σ_across²

and summed over S × S fine pixels, as every element of z is. An edge a few degrees off the grid crosses it at
many phases, which shows what lies between its points; others are left out. The σ² of all windows give both
widths by least squares, with uncertainties. Of the target nothing has to be known but that edges are sharp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares
from scipy.special import ndtr

from acquire.calibrate.apply import calibrated
from acquire.calibrate.calibration import Finding, Measured
from acquire.calibrate.still import stills
from acquire.errors import UsageError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure
    from acquire.calibrate.still import Still

WINDOW = 9
"""Coarse pixels of a window's side: edges are that far from others."""
OVERLAP = 3
"""Windows are a third of their side apart, both ways: nine of them see every edge, and are worth one."""
MOST_LINES = 4096
MOST_WINDOWS = 200
"""Of an arm, those with the strongest edges."""
MOST_STEPS = 30
"""Of a window's fit: an edge takes ten."""
CLEAR = 10.0
"""An edge's step beside the noise of the image's elements."""
STRAIGHT = 0.02
"""RMS of what a straight edge leaves, of its step, beyond which there is something else in the window."""
NOISES = 1.3
"""The same beside the image's noise, which alone is 1."""
LARGEST_SIGMA = 4.0
"""Fine pixels; a wider edge does not end inside its window."""
FEWEST = 6
"""Windows that have to agree, of each arm."""
SLANTED = 0.7
"""Fine pixels that an edge has to cross the grid by, inside a window: it then shows what lies between."""
SHAPE = 0.04
"""Fine pixels²: of σ², for what of a blur is no Gaussian and of an edge no step."""
SURE = 0.1
"""Variance in fine pixels², of which either axis has to be as sure: σ = 0.6 is then told as 0.6 ± 0.08."""


@dataclass(frozen=True, slots=True)
class Edge:
    """One window's: normal (rows, columns), and the variance of the blur along it with its uncertainty."""

    normal: tuple[float, float]
    variance: float
    uncertainty: float


def psf(exposure: Exposure, known: Calibration) -> Finding:
    """Standard deviations of either arm's blur, along and across its transfer, in fine pixels.

    An axis that the target says nothing of is not told, and then nothing is. Raises UsageError where no edges
    are found, where they do not tell an axis, and for lines behind a fibre.
    """
    recording = exposure.recording
    if recording.fibre is not None:
        raise UsageError(
            f"{recording} shows a target behind a fibre: edges are not followed from band to band",
            possible="a recording without a fibre",
        )
    if exposure.code_value is not None:
        raise UsageError(
            f"{recording} has a constant code, which does not tell the rows of a scene apart",
            possible="a pseudo-random code: code.kind = 'prbs'",
        )
    lines = min(exposure.lines, MOST_LINES)
    plain = without_blur(replace(known, orientation=None, alignment=None))
    segment = calibrated(replace(exposure, lines=lines).whole(), plain)
    S = segment.geometry.substeps
    values, doubts, facts = [], [], {}
    for arm, still in zip(ARMS, stills(segment), strict=True):
        edges = straight_edges(still, S, arm)
        variance, doubt, scatter = widths(edges, arm)
        values.append(variance)
        doubts.append(doubt)
        facts[arm] = {"edges": len(edges), "scatter": round(scatter, 3)}
    variances, uncertainties = np.array(values), np.array(doubts)
    # σ and its uncertainty from those of σ²: near 0 the root of what σ² may be at most
    sigma = np.sqrt(np.maximum(variances, 0))
    doubt = np.where(sigma**2 > uncertainties, uncertainties / (2 * sigma.clip(1e-9)), np.sqrt(uncertainties))
    unclear = variances < 2 * uncertainties
    return Finding(
        "psf",
        exposure.instrument,
        {"blur_px": Measured(sigma, doubt)},
        facts={
            **exposure.facts(),
            "lines": lines,
            **facts,
            "variance_px2": variances.round(5).tolist(),
            "variance_uncertainty_px2": uncertainties.round(5).tolist(),
        },
        warnings=_narrow(unclear, variances + 2 * uncertainties),
    )


def without_blur(known: Calibration) -> Calibration:
    """The calibration without the optics' width."""
    return replace(known, quantities={k: v for k, v in known.quantities.items() if k != "blur_px"})


def _narrow(unclear: NDArray[np.bool_], most: NDArray[np.float64]) -> tuple[str, ...]:
    return tuple(
        f"arm {arm} {axis} the transfer: it cannot be told from no blur at all; at most "
        f"{np.sqrt(max(most[i, j], 0)):.2f} fine pixels"
        for i, arm in enumerate(ARMS)
        for j, axis in enumerate(("along", "across"))
        if unclear[i, j]
    )


def widths(edges: list[Edge], arm: str) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Variances along and across, their uncertainties, and the scatter of edges beside what each says.

    UsageError where the edges do not tell.
    """
    if len(edges) < FEWEST:
        raise _untold(arm, f"{len(edges)} windows hold a straight, sharp, slanted edge and nothing else")
    design = np.array([each.normal for each in edges]) ** 2
    told = np.array([each.variance for each in edges])
    errors = np.array([each.uncertainty for each in edges])
    weighted = design / errors[:, None]

    def left(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((design @ numbers - told) / errors)

    solved = least_squares(left, np.full(2, np.median(told)), loss="soft_l1")
    gram = weighted.T @ weighted
    if np.linalg.cond(gram) > 1e10:
        raise _untold(arm, "its edges all lie one way")
    # what windows scatter beyond their own errors is the target's, and as uncertain
    scatter = float(1.4826 * np.median(np.abs(left(solved.x))))
    doubt = np.hypot(OVERLAP * np.sqrt(np.diag(np.linalg.inv(gram))) * max(1.0, scatter), SHAPE)
    for axis, sure, what in zip(("along", "across"), doubt, ("across", "along"), strict=True):
        if not sure <= SURE:
            raise _untold(
                arm, f"they say nothing of its blur {axis} the transfer; edges {what} it, slanted, would"
            )
    return np.asarray(solved.x), doubt, scatter


def _untold(arm: str, why: str) -> UsageError:
    return UsageError(
        f"cannot tell how wide the optics of arm {arm} blur: {why}",
        possible=f"straight sharp edges {WINDOW} coarse pixels from any other, some along the columns and "
        "some across them, each slanted by 3 to 20 degrees",
        hint="a square or a checkerboard, turned a little, at rest and in focus; 1024 lines or more",
    )


def straight_edges(still: Still, substeps: int, arm: str) -> list[Edge]:
    """Windows of an arm's image that hold one straight edge and nothing else. UsageError for noise alone."""
    S, image = substeps, still.image
    high, wide = WINDOW * S, WINDOW
    rows = np.arange(S, image.shape[0] - high - S + 1, high // OVERLAP)
    columns = np.arange(1, image.shape[1] - wide, wide // OVERLAP)
    places = [(r, c) for r in rows for c in columns if still.usable[c : c + wide].all()]
    windows = {place: image[place[0] : place[0] + high, place[1] : place[1] + wide] for place in places}
    steps = {place: _step(window) for place, window in windows.items()}
    ranked = sorted(places, key=lambda place: -steps[place])[:MOST_WINDOWS]
    noise = still.uncertainty
    if not ranked or steps[ranked[0]] <= CLEAR * noise:
        best = steps[ranked[0]] / noise if ranked else 0.0
        raise _untold(
            arm, f"its best edge is {best:.1f} times the image's noise, of {CLEAR:g} that are needed"
        )
    found = (_fitted(windows[place], S, noise) for place in ranked if steps[place] > CLEAR * noise)
    return [edge for edge in found if edge is not None]


def _step(window: NDArray[np.float64]) -> float:
    low, high = np.quantile(window, (0.1, 0.9))
    return float(high - low)


def _fitted(window: NDArray[np.float64], S: int, noise: float) -> Edge | None:
    """The edge of a window; None where it holds something else."""
    rows, columns = np.indices(window.shape, np.float64)
    y, x = rows - rows.mean(), S * (columns - columns.mean())
    low, high = np.quantile(window, (0.1, 0.9))
    # where the light's plane falls, and how far from the middle its half lies
    slope = np.array([(window * y).sum() / (y**2).sum(), (window * x).sum() / (x**2).sum()])
    angle = float(np.arctan2(slope[1], slope[0]))
    along = y * np.cos(angle) + x * np.sin(angle)
    bright = float(((window - low) / (high - low)).clip(0, 1).mean())
    start = np.array([low, high - low, angle, float(np.quantile(along, 1 - bright)), 1.0])

    def left(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        floor, step, turn, at, width = numbers
        normal = np.cos(turn), np.sin(turn)
        edge = floor + step * _edge(y * normal[0] + x * normal[1] - at, width, S, normal)
        return np.asarray((edge - window).ravel())

    bounds = ([-np.inf, 0, angle - 1, -np.inf, 0.02], [np.inf, np.inf, angle + 1, np.inf, 2 * LARGEST_SIGMA])
    scale = [high - low, high - low, 0.1, 1.0, 0.5]
    try:
        solved = least_squares(left, start, x_scale=scale, bounds=bounds, max_nfev=MOST_STEPS)
    except (ValueError, np.linalg.LinAlgError):
        return None
    step, width = float(solved.x[1]), float(solved.x[4])
    rms = float(np.sqrt(np.mean(solved.fun**2)))
    if not (step > CLEAR * noise and rms < max(STRAIGHT * step, NOISES * noise) and width < LARGEST_SIGMA):
        return None
    # near 0 the edge hardly depends on the width, but on its square, which is what is asked
    jacobian = np.asarray(solved.jac, np.float64)
    if width < 0.05:
        jacobian[:, 4] = (left(solved.x + np.array([0, 0, 0, 0, 0.3])) - solved.fun) / 0.3**2
    try:
        covariance = np.linalg.inv(jacobian.T @ jacobian) * max(rms, noise) ** 2
    except np.linalg.LinAlgError:
        return None
    uncertainty = (1.0 if width < 0.05 else 2 * width) * float(np.sqrt(covariance[4, 4]))
    normal = float(np.cos(solved.x[2])), float(np.sin(solved.x[2]))
    if min(map(abs, normal)) * len(window) < SLANTED:
        return None
    return Edge(normal, width**2, max(uncertainty, 1e-4)) if np.isfinite(uncertainty) else None


def _edge(
    distance: NDArray[np.float64], sigma: float, S: int, normal: tuple[float, float]
) -> NDArray[np.float64]:
    """A step that is blurred and summed over a pixel, from 0 to 1, ``distance`` behind the edge."""
    wide, narrow = (max(S * abs(each), 0.02) for each in normal)

    def twice(at: NDArray[Any]) -> NDArray[Any]:
        """The second integral of the Gaussian."""
        scaled = at / sigma
        density = np.exp(-0.5 * scaled**2) / np.sqrt(2 * np.pi)
        return np.asarray(((at**2 + sigma**2) * ndtr(scaled) + at * sigma * density) / 2)

    far, near = (wide + narrow) / 2, (wide - narrow) / 2
    summed = twice(distance + far) - twice(distance + near) - twice(distance - near) + twice(distance - far)
    return np.asarray(summed / (wide * narrow))
