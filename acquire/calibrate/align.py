"""Alignment of arm B's image with arm A's: shift, rotation, magnification, distortion, from a target at rest.

Arm A's image is finely sampled along rows, arm B's along columns (`still`), and both are box-filtered alike.
They are compared where a coarse column of A meets a coarse row of B in the scene, so that each is
interpolated only along its own fine axis, where it is well sampled. Each point gives the displacement along
one direction of texture. Over the field these give shift, rotation and magnification by least squares, and
the radial distortion if there is one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates, spline_filter
from scipy.optimize import least_squares

from acquire.alignment import LARGEST_DISTORTION, Alignment
from acquire.blur import falling
from acquire.calibrate.calibration import AlignmentFound
from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.still import Still
    from acquire.geometry import Geometry

SMOOTHINGS = (4.0, 0.0)
"""Smoothing of the images in fine pixels: coarse first, so that a start some pixels off converges."""
EDGE = 4
"""Fine pixels at the rim that are not compared, since splines and dark columns affect them."""
NUMBERS = ("rows", "columns", "turn_deg", "magnification", "distortion")
BRIGHTNESS = (4, 5)
"""Places among the fitted numbers of the factor and the offset of arm B's brightness."""
DISTORTED_PIXELS, DISTORTED_SURE = 0.05, 5.0
"""Least distortion that counts, in fine pixels at the middle of a side and in standard uncertainties."""
LEAST_FALL, FALL_SURE = 0.015, 8.0
"""Least fall of the light from the centre to a side that counts, as a part and in standard uncertainties."""
BEND = 1.0
"""Smoothing of second derivatives in fine pixels, below which they are mostly noise."""
POINT_ROUNDS = 5
"""Rounds to a point's position in both images, each of which reduces its error by twice the distortion."""
WORST_PIXELS = 0.2
"""Uncertainty of shift, turn or magnification, in fine pixels at the field's edge, beyond which an alignment
is useless, as from a target without texture."""
LEAST_CORRELATION = 0.5
"""Of the two images where they meet. Without texture, noise alone may seem to determine an alignment."""


@dataclass(frozen=True, slots=True, eq=False)
class FallOff:
    """What a lens takes of the light on A's rows and B's columns: r₁, r₂, c₁, c₂, and their uncertainties.

    ``brightness`` is the light of arm B over that of arm A in the centre.
    """

    terms: NDArray[np.float64]
    errors: NDArray[np.float64]
    brightness: float

    @property
    def clear(self) -> bool:
        """Whether there is any."""
        return bool(self._clear.any())

    @property
    def in_b(self) -> bool:
        """Whether there is any along the transfer of arm B, where a field's end does not look like it."""
        return bool(self._clear[2:].any())

    @property
    def words(self) -> str:
        """What the arms' images show of it."""
        x, (r1, r2, c1, c2) = np.linspace(-1, 1, 65), self.terms
        least = min(float(falling(pair, x).min()) for pair in ((r1, r2), (c1, c2)))
        return f"the arms' images differ in the light on the field, by up to {1 - least:.0%} towards a side"

    def facts(self) -> dict[str, list[float]]:
        """Return the terms and their uncertainties as JSON."""
        values = {"terms": self.terms, "uncertainty": self.errors}
        return {name: [round(float(each), 6) for each in row] for name, row in values.items()}

    @property
    def _clear(self) -> NDArray[np.bool_]:
        return np.asarray(np.abs(self.terms) > np.maximum(LEAST_FALL, FALL_SURE * self.errors))


@dataclass(frozen=True, slots=True)
class Match:
    """An alignment and its quality.

    ``misfit`` is the residual difference of the images relative to their own variation, ``brightness`` the
    light of arm B over that of arm A, summed over the points that both see.
    """

    found: AlignmentFound
    misfit: float
    brightness: float
    fall_off: FallOff


def align(a: Still, b: Still, geometry: Geometry, start: tuple[float, float] = (0.0, 0.0)) -> Match:
    """Align arm B with arm A, with ``b`` as the model turns it; ``start`` is a rough shift in fine pixels.

    Raises UsageError if the target has too little texture to determine the alignment.
    """
    images = _Images(a, b, geometry)
    fit = _fit(images, np.array([*start, 0.0, 0.0, 1.0, 0.0]))
    if not fit.determined:
        raise _undetermined()
    distorted = _fit(images, np.append(fit.numbers, 0.0))
    half = geometry.size / 2
    moved, sure = (float(half * each) for each in (distorted.alignment.distortion, distorted.errors[-1]))
    if distorted.determined and abs(moved) > max(DISTORTED_PIXELS, DISTORTED_SURE * sure):
        fit = distorted
    comparison, numbers = fit.comparison, fit.numbers
    if comparison.correlation(numbers) < LEAST_CORRELATION:
        raise _undetermined()
    errors = np.delete(fit.errors, BRIGHTNESS).tolist()
    uncertainty = dict(zip(NUMBERS, errors, strict=False))
    found = AlignmentFound(fit.alignment, uncertainty)
    return Match(
        found, comparison.misfit(numbers), comparison.brightness(numbers), comparison.fall_off(numbers)
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Fitted ``numbers`` of a `_Comparison`, and the uncertainties of what they mean (inf: undetermined)."""

    comparison: _Comparison
    numbers: NDArray[np.float64]
    alignment: Alignment
    errors: NDArray[np.float64]

    @property
    def determined(self) -> bool:
        """Whether no number displaces the field's edge by an unknown amount."""
        pixels = self.errors / _units(self.comparison.geometry)[: len(self.errors)]
        return bool(np.delete(pixels, BRIGHTNESS).max() <= WORST_PIXELS)


def _fit(images: _Images, numbers: NDArray[np.float64]) -> _Fit:
    """Fit the ``numbers`` from a start, with the distortion if there are seven."""
    for sigma in SMOOTHINGS:
        comparison = _Comparison(images, sigma)
        # Outliers are identified by the spread of the differences, far above the noise in clean images.
        for loss in ("linear", "soft_l1"):
            # 0.6745 σ is the median of the absolute values of normal noise
            spread = float(np.median(np.abs(comparison(numbers)))) / 0.6745
            solved = least_squares(
                comparison,
                numbers,
                x_scale=comparison.scale[: len(numbers)],
                # scipy's `lm` has no robust loss
                method="trf",
                loss=loss,
                f_scale=max(1.0, spread),
            )
            numbers = solved.x
    freedom = max(1, len(solved.fun) - len(numbers))
    units = _units(images.geometry)[: len(numbers)]
    try:
        jacobian = np.asarray(solved.jac, np.float64)
        # scipy's cost is half the sum of squares.
        covariance = np.linalg.inv(jacobian.T @ jacobian) * 2 * solved.cost / freedom
        errors = np.sqrt(np.diag(covariance)) * units
    except np.linalg.LinAlgError:
        errors = np.full(len(numbers), np.inf)
    return _Fit(comparison, numbers, _alignment(numbers, images.geometry), errors)


def _undetermined() -> UsageError:
    return UsageError(
        "the target does not determine the alignment of the arms: it has too little texture, or moves",
        possible="sharp dots or a binary pattern of 2 to 6 fine pixels all over, or the USAF target",
    )


def _units(geometry: Geometry) -> NDArray[np.float64]:
    """Return the units of the fitted numbers: rotation, magnification and distortion at the field's edge."""
    half = geometry.size / 2
    return np.array([1, 1, np.rad2deg(1 / half), 1 / half, 1, 1, 1 / half])


def _alignment(numbers: NDArray[np.float64], geometry: Geometry) -> Alignment:
    values = np.delete(numbers * _units(geometry)[: len(numbers)], BRIGHTNESS)
    rows, columns, turn, larger, *distortion = values.tolist()
    # a step of the fit may go too far
    clipped = np.clip(distortion, -LARGEST_DISTORTION, LARGEST_DISTORTION).tolist()
    return Alignment(rows, columns, turn, 1 + larger, *clipped)


class _Images:
    """Both arms' images in arm A's view, A (n + S − 1, M) and B (M, n + S − 1), and their usable parts."""

    def __init__(self, a: Still, b: Still, geometry: Geometry) -> None:
        self.geometry = geometry
        # B sees the scene turned by 90° counter-clockwise
        self.a, self.b = a.image, np.rot90(b.image, -1)
        self.columns, self.rows = a.usable, b.usable
        self.weight = 1 / max(float(np.hypot(a.uncertainty, b.uncertainty)), 1e-12)


class _Comparison:
    """Differences of the images at the points where their lattices cross, as a function of six or 7 numbers.

    These are the shift (2), rotation and magnification as pixels at the field's edge, the factor and offset
    of B's brightness relative to A's, and the distortion as pixels at the middle of a side.
    """

    def __init__(self, images: _Images, sigma: float) -> None:
        self._images, self.geometry = images, images.geometry
        geometry = self.geometry
        n, S = geometry.size, geometry.substeps
        self._n, self._S, self._middle = n, S, (n - 1) / 2
        a, b = images.a, images.b
        if sigma:
            # S fine pixels are one coarse pixel
            a, b = gaussian_filter(a, (sigma, sigma / S)), gaussian_filter(b, (sigma / S, sigma))
        # once for all evaluations, which then interpolate without a filter
        self._a, self._b = spline_filter(a, mode="nearest"), spline_filter(b, mode="nearest")
        coarse = S * np.arange(geometry.stages) + (S - 1) / 2
        self._b_rows, self._a_columns = np.meshgrid(coarse, coarse, indexing="ij")
        good = images.rows[:, None] & images.columns
        inside = (np.abs(coarse - self._middle) < self._middle - EDGE)[:, None]
        self._good = good & inside & inside.T
        level = max(float(np.abs(a).mean()), 1e-12)
        self.scale = np.array([0.1, 0.1, 0.1, 0.1, 0.01, 0.01 * level, 0.1])
        self._level = float(a.std())

    def __call__(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b, inside, _ = self._pairs(numbers)
        # 0 outside, because `least_squares` needs the same number of residuals in every call
        residual = np.where(inside, b - numbers[4] * a - numbers[5], 0.0)[self._good]
        weighted: NDArray[np.float64] = residual * self._images.weight
        return weighted

    def misfit(self, numbers: NDArray[np.float64]) -> float:
        """Return the RMS of the differences, relative to the images' variation."""
        a, b, inside, _ = self._pairs(numbers)
        residual = (b - numbers[4] * a - numbers[5])[self._good & inside]
        if not residual.size:
            return float("inf")
        return float(np.sqrt(np.mean(residual**2)) / max(self._level, 1e-12))

    def correlation(self, numbers: NDArray[np.float64]) -> float:
        """Return the correlation coefficient of the images; 0 where either is uniform."""
        a, b, inside, _ = self._pairs(numbers)
        a, b = (image[self._good & inside] for image in (a, b))
        if a.size < 2 or not (a.std() > 0 and b.std() > 0):
            return 0.0
        return float(np.corrcoef(a, b)[0, 1])

    def brightness(self, numbers: NDArray[np.float64]) -> float:
        """Return B's light over A's; not the fitted factor, which blur and noise of each image lower."""
        a, b, inside, _ = self._pairs(numbers)
        common = self._good & inside
        total = float(a[common].sum())
        return float(b[common].sum()) / total if total > 0 else 1.0

    def fall_off(self, numbers: NDArray[np.float64]) -> FallOff:
        """Fit B = A·(1 + c₁·x + c₂·x²)/(1 + r₁·y + r₂·y²), with A's row y and B's column x from −1 to 1."""
        a, b, inside, (y, x) = self._pairs(numbers)
        common = self._good & inside
        # What an edge lacks in one arm that blurs more looks like light. To first order that is a multiple of
        # the image's second derivative, which each arm shows along its own fine axis.
        rows_a, columns_a, rows_b, columns_b, *_ = self._points(numbers)
        bend_a = _sampled(_bend(self._images.a, 0), rows_a, columns_a)
        bend_b = _sampled(_bend(self._images.b, 1), rows_b, columns_b)
        a, b, y, x, bend_a, bend_b = (each[common] for each in (a, b, y, x, bend_a, bend_b))

        def light(terms: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            r1, r2, c1, c2 = terms[:4]
            return falling((r1, r2), y), falling((c1, c2), x)

        def residual(terms: NDArray[np.float64]) -> NDArray[np.float64]:
            rows, columns = light(terms)
            sharper = terms[6] * bend_a + terms[7] * bend_b
            return np.asarray((b - terms[4] * a * columns / rows - terms[5] - sharper) * self._images.weight)

        start = np.array([0, 0, 0, 0, numbers[4], numbers[5], 0, 0])
        spread = float(np.median(np.abs(residual(start)))) / 0.6745
        # within the bounds both are above 0
        most = np.array([0.4, 0.5, 0.4, 0.5, np.inf, np.inf, np.inf, np.inf])
        solved = least_squares(
            residual, start, bounds=(-most, most), loss="soft_l1", f_scale=max(1.0, spread), x_scale="jac"
        )
        jacobian = np.asarray(solved.jac, np.float64)
        freedom = max(1, len(a) - len(start))
        errors = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * 2 * solved.cost / freedom)
        rows, columns = light(solved.x)
        return FallOff(solved.x[:4], errors[:4], float((b / columns).sum() / (a / rows).sum()))

    def _pairs(
        self, numbers: NDArray[np.float64]
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_], tuple[NDArray[Any], NDArray[Any]]]:
        """Return A and B where they show the same point, whether both cover it, and A's row and B's column.

        The last two are from −1 to 1 over the field.
        """
        rows_a, columns_a, rows_b, columns_b, inside, at = self._points(numbers)
        return _sampled(self._a, rows_a, columns_a), _sampled(self._b, rows_b, columns_b), inside, at

    def _points(
        self, numbers: NDArray[np.float64]
    ) -> tuple[
        NDArray[Any],
        NDArray[Any],
        NDArray[Any],
        NDArray[Any],
        NDArray[np.bool_],
        tuple[NDArray[Any], NDArray[Any]],
    ]:
        """Return rows and columns in A's image and in B's, and the last two values of `_pairs`."""
        # Row y of B and column x of A show one point if (y, q)·f = m·Q·(p, x) + shift, all from the middle:
        # two equations, linear in p, the row of A, and q, the column of B. Without distortion f is 1.
        alignment = _alignment(numbers, self.geometry)
        (d, e), (f, g) = alignment.matrix
        y, x = self._b_rows - self._middle, self._a_columns - self._middle
        p = (y - alignment.rows - e * x) / d
        q = f * p + g * x + alignment.columns
        if alignment.distortion:
            k = alignment.distortion / (self._n / 2) ** 2
            for _ in range(POINT_ROUNDS):
                factor = 1 - k * (y**2 + q**2)
                p = (y * factor - alignment.rows - e * x) / d
                q = (f * p + g * x + alignment.columns) / factor
        at_a_row, at_b_column = p + self._middle, q + self._middle
        # row m of an image is the sum over S fine rows up to m, and is centred (S − 1)/2 before it
        half = (self._S - 1) / 2
        rows_a = at_a_row + half
        columns_a = (self._a_columns - half) / self._S
        rows_b = (self._b_rows - half) / self._S
        columns_b = at_b_column + half
        low, high = EDGE, self._n - 1 - EDGE
        inside = (at_a_row > low) & (at_a_row < high) & (at_b_column > low) & (at_b_column < high)
        at = p / (self._n / 2), q / (self._n / 2)
        return rows_a, columns_a, rows_b, columns_b, inside, at


def _sampled(image: NDArray[Any], rows: NDArray[Any], columns: NDArray[Any]) -> NDArray[Any]:
    """Return the values at these positions of an image that `spline_filter` has prepared."""
    found: NDArray[Any] = map_coordinates(image, [rows, columns], order=3, mode="nearest", prefilter=False)
    return found


def _bend(image: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the second derivative along the fine axis, prepared for `_sampled`."""
    smooth = gaussian_filter1d(image, BEND, axis=axis, order=2, mode="nearest")
    return np.asarray(spline_filter(smooth, mode="nearest"))
