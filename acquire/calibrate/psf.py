"""Width of the optics' blur in each arm, from straight sharp edges of a target at rest.

This is the slanted-edge method (ISO 12233) as a fit. An arm's image of a target (`still`) is divided into
small windows, and a window with nothing but a straight edge is

    z(p) = low + step·E(p·ν − d),     E = Φ_σ ∗ box of S·|ν_rows| ∗ box of S·|ν_columns|

with the edge's normal ν: a step, blurred by a Gaussian of variance

    σ² = ν_rows²·σ_along² + ν_columns²·σ_across²

and summed over S × S fine pixels, like every element of z. An edge a few degrees off the grid crosses it at
many phases, which resolves the profile between grid points; other edges are left out. The σ² of all windows
give both widths by least squares, with uncertainties. Nothing has to be known about the target except that
its edges are sharp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares
from scipy.special import ndtr

from acquire.calibrate.apply import calibrated
from acquire.calibrate.calibration import Finding, Measured
from acquire.calibrate.checks import refuse_constant, refuse_fibre
from acquire.calibrate.still import stills
from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.noise import robust_sigma
from acquire.text import counted

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure
    from acquire.calibrate.still import Still

WINDOWS = (9, 7)
"""Sides of windows in coarse pixels, and thus the least distances between edges. Large ones suffer less from
noise, small ones find more edges between other detail, as on the sheet; those that are surer count."""
OVERLAP = 3
"""Windows per side length in each direction: nine of them contain every edge, and count as one."""
MOST_LINES = 4096
MOST_WINDOWS = 200
"""Upper limit on the windows of an arm, those with the strongest edges."""
MOST_STEPS = 30
"""Upper limit on the steps of a window's fit; an edge takes ten."""
CLEAR = 10.0
"""Least step of an edge relative to the noise of the image's elements."""
STRAIGHT = 0.02
"""Largest RMS residual of a straight edge, relative to its step, in a window without anything else."""
NOISES = 1.3
"""The same relative to the image's noise, which alone gives 1."""
ALIKE = 0.3
"""Largest RMS residual of an edge before it is fitted, relative to its step. Of 1500 edges that a fit
accepted, few had more; of windows with dots, whose fits take most of the time, half had."""
LARGEST_SIGMA = 4.0
"""In fine pixels; a wider edge extends beyond its window."""
FEWEST = 6
"""Least number of windows of each arm."""
SLANTED = 0.7
"""Fine pixels by which an edge must cross the grid inside a window, to resolve its profile."""
SHAPE = 0.04
"""Uncertainty of σ², in fine pixels², because a blur is not exactly Gaussian nor an edge exactly a step."""
WELL = 0.06
"""Uncertainty of the variances with which no other size of windows is tried: σ = 0.6 is right to 0.05."""
SURE = 0.1
"""Largest uncertainty of each axis's variance, in fine pixels²: σ = 0.6 then has an uncertainty of 0.08."""


@dataclass(frozen=True, slots=True)
class Edge:
    """The edge of one window: normal (rows, columns), variance of the blur along it, and its uncertainty."""

    normal: tuple[float, float]
    variance: float
    uncertainty: float


def psf(exposure: Exposure, known: Calibration) -> Finding:
    """Measure the standard deviations of each arm's blur, along and across its transfer, in fine pixels.

    Raises UsageError if no edges are found, if they do not determine both axes, and for lines behind a fibre.
    """
    refuse_fibre(exposure)
    refuse_constant(exposure)
    lines = min(exposure.lines, MOST_LINES)
    # the images of the cameras themselves, in their own rows and columns
    plain = without_blur(replace(known, orientation=None, alignment=None))
    segment = calibrated(replace(exposure, lines=lines).whole(), plain)
    S = segment.geometry.substeps
    values, doubts, facts = [], [], {}
    for arm, still in zip(ARMS, stills(segment), strict=True):
        variance, doubt, fact = _surest(still, S, arm)
        values.append(variance)
        doubts.append(doubt)
        facts[arm] = fact
    variances, uncertainties = np.array(values), np.array(doubts)
    # σ and its uncertainty from those of σ²; near 0 the root of the largest likely σ²
    sigma = np.sqrt(np.maximum(variances, 0))
    doubt = np.where(sigma**2 > uncertainties, uncertainties / (2 * sigma.clip(1e-9)), np.sqrt(uncertainties))
    most = np.sqrt(np.maximum(variances + 2 * uncertainties, 0))
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
        warnings=tuple(
            f"arm {arm} {axis} the transfer: the blur is not clearly above 0; it is at most "
            f"{most[i, j]:.2f} fine pixels"
            for i, arm in enumerate(ARMS)
            for j, axis in enumerate(("along", "across"))
            if variances[i, j] < 2 * uncertainties[i, j]
        ),
    )


def without_blur(known: Calibration) -> Calibration:
    """Return the calibration without the optics' blur."""
    return replace(known, quantities={k: v for k, v in known.quantities.items() if k != "blur_px"})


def _surest(
    still: Still, S: int, arm: str
) -> tuple[NDArray[np.float64], NDArray[np.float64], dict[str, float]]:
    """Return the variances and uncertainties from the windows of the size that shows them best, and facts.

    Raises UsageError if no size determines both variances.
    """
    found, why = [], None
    for window in WINDOWS:
        try:
            edges = straight_edges(still, S, arm, window)
            variance, doubt, scatter = widths(edges, arm)
        except UsageError as error:
            why = error
            continue
        found.append((variance, doubt, {"edges": len(edges), "scatter": round(scatter, 3), "window": window}))
        if doubt.max() <= WELL:
            break
    if not found:
        assert why is not None
        raise why
    return min(found, key=lambda each: float(each[1].max()))


def widths(edges: list[Edge], arm: str) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return variances along and across, their uncertainties, and the edges' scatter in their own errors.

    Raises UsageError if the edges do not determine both variances.
    """
    if len(edges) < FEWEST:
        windows = counted(len(edges), "window")
        raise _undetermined(arm, f"only {windows} with just one straight, sharp, slanted edge")
    design = np.array([each.normal for each in edges]) ** 2
    variances = np.array([each.variance for each in edges])
    errors = np.array([each.uncertainty for each in edges])
    weighted = design / errors[:, None]

    def residual(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((design @ numbers - variances) / errors)

    solved = least_squares(residual, np.full(2, np.median(variances)), loss="soft_l1")
    gram = weighted.T @ weighted
    if np.linalg.cond(gram) > 1e10:
        raise _undetermined(arm, "its edges all have the same direction")
    # Scatter of the windows beyond their own errors is due to the target, and adds to the uncertainty.
    scatter = robust_sigma(residual(solved.x))
    # The OVERLAP² windows that contain the same edge count as one, hence the factor of its root.
    doubt = np.hypot(OVERLAP * np.sqrt(np.diag(np.linalg.inv(gram))) * max(1.0, scatter), SHAPE)
    for axis, uncertainty, needed in zip(("along", "across"), doubt, ("across", "along"), strict=True):
        if not uncertainty <= SURE:
            raise _undetermined(
                arm, f"its edges do not show the blur {axis} the transfer; slanted edges {needed} it would"
            )
    return np.asarray(solved.x), doubt, scatter


def _undetermined(arm: str, why: str) -> UsageError:
    return UsageError(
        f"the blur of the optics of arm {arm} cannot be measured: {why}",
        possible=f"straight sharp edges {WINDOWS[0]} coarse pixels from any other, some along the columns "
        "and some across them, each slanted by 3 to 20 degrees",
        hint="a square or a checkerboard, slightly turned, at rest and in focus, or the sheet that acquire "
        "calibrate sheet draws; 1024 lines or more",
    )


def straight_edges(still: Still, substeps: int, arm: str, window: int = WINDOWS[0]) -> list[Edge]:
    """Find the windows of an arm's image that contain one straight edge and nothing else.

    Raises UsageError if the image contains nothing but noise.
    """
    S, image = substeps, still.image
    high, wide = window * S, window
    # the first and last rows of an image are sums over fewer than S rows of the scene
    rows = np.arange(S, image.shape[0] - high - S + 1, high // OVERLAP)
    columns = np.arange(1, image.shape[1] - wide, wide // OVERLAP)
    places = [(r, c) for r in rows for c in columns if still.usable[c : c + wide].all()]
    cuts = {place: image[place[0] : place[0] + high, place[1] : place[1] + wide] for place in places}
    # The step is taken between quantiles, which noise hardly changes.
    steps = {place: float(np.subtract(*np.quantile(cut, (0.9, 0.1)))) for place, cut in cuts.items()}
    ranked = sorted(places, key=lambda place: -steps[place])[:MOST_WINDOWS]
    noise = still.uncertainty
    if not ranked or steps[ranked[0]] <= CLEAR * noise:
        # without light, or in a simulation without effects, there may be no noise either
        best = steps[ranked[0]] / noise if ranked and noise > 0 else 0.0
        raise _undetermined(
            arm, f"its best edge is {best:.1f} times the image's noise, and {CLEAR:g} times are needed"
        )
    found = (_fitted(cuts[place], S, noise) for place in ranked if steps[place] > CLEAR * noise)
    return [edge for edge in found if edge is not None]


def _fitted(window: NDArray[np.float64], S: int, noise: float) -> Edge | None:
    """Fit the edge of a window; None if the window contains something else."""
    rows, columns = np.indices(window.shape, np.float64)
    # both in fine pixels
    y, x = rows - rows.mean(), S * (columns - columns.mean())
    low, high = np.quantile(window, (0.1, 0.9))
    # Start from the direction of a fitted plane, and from the distance that splits off the bright share.
    slope = np.array([(window * y).sum() / (y**2).sum(), (window * x).sum() / (x**2).sum()])
    angle = float(np.arctan2(slope[1], slope[0]))
    along = y * np.cos(angle) + x * np.sin(angle)
    bright = float(((window - low) / (high - low)).clip(0, 1).mean())
    start = np.array([low, high - low, angle, float(np.quantile(along, 1 - bright)), 1.0])

    def residual(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        floor, step, turn, at, width = numbers
        normal = np.cos(turn), np.sin(turn)
        edge = floor + step * _edge(y * normal[0] + x * normal[1] - at, width, S, normal)
        return np.asarray((edge - window).ravel())

    if float(np.sqrt(np.mean(residual(start) ** 2))) > ALIKE * (high - low) + noise:
        return None
    bounds = ([-np.inf, 0, angle - 1, -np.inf, 0.02], [np.inf, np.inf, angle + 1, np.inf, 2 * LARGEST_SIGMA])
    scale = [high - low, high - low, 0.1, 1.0, 0.5]
    try:
        solved = least_squares(residual, start, x_scale=scale, bounds=bounds, max_nfev=MOST_STEPS)
    except (ValueError, np.linalg.LinAlgError):
        return None
    step, width = float(solved.x[1]), float(solved.x[4])
    rms = float(np.sqrt(np.mean(solved.fun**2)))
    if not (step > CLEAR * noise and rms < max(STRAIGHT * step, NOISES * noise) and width < LARGEST_SIGMA):
        return None
    # Near 0 the edge depends on the square of the width rather than the width, and the square is the result.
    jacobian = np.asarray(solved.jac, np.float64)
    if width < 0.05:
        jacobian[:, 4] = (residual(solved.x + np.array([0, 0, 0, 0, 0.3])) - solved.fun) / 0.3**2
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
    """Return a step from 0 to 1, blurred and summed over a pixel, at ``distance`` behind the edge."""
    # not 0, by which the result is divided
    wide, narrow = (max(S * abs(each), 0.02) for each in normal)

    def twice(at: NDArray[Any]) -> NDArray[Any]:
        """Return the second integral of the Gaussian."""
        scaled = at / sigma
        density = np.exp(-0.5 * scaled**2) / np.sqrt(2 * np.pi)
        return np.asarray(((at**2 + sigma**2) * ndtr(scaled) + at * sigma * density) / 2)

    # a convolution with two boxes is a second difference of the second integral
    far, near = (wide + narrow) / 2, (wide - narrow) / 2
    summed = twice(distance + far) - twice(distance + near) - twice(distance - near) + twice(distance - far)
    return np.asarray(summed / (wide * narrow))
