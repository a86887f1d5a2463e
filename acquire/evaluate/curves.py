"""Intensity of a region over time, its sinusoidal fit, and a comparison of both with theory (Fig. 9c).

A sinusoid is linear in all its parameters except the frequency f::

    v(t) = offset + Σ_k  p_k·sin(2π·k·f·t) + q_k·cos(2π·k·f·t)          k = 1 .. harmonics

so the residual of a linear least-squares fit depends on f alone (variable projection). It is minimised within
the main lobe around the highest peak of the spectrum. Overtones (k > 1) describe the distortion of an LED
that is driven into saturation; "amplitude" always means that of the fundamental.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import minimize_scalar

from acquire.errors import UsageError
from acquire.evaluate.metrics import check_finite

if TYPE_CHECKING:
    from numpy.typing import NDArray

CONSTANT_SWING = 1e-6
"""A curve whose swing is below this share of its largest value is constant, up to rounding of float32."""
HARMONICS = 3
"""Fundamental, second and third harmonic: a saturating LED turns a sinusoid into these."""
LOWEST = 0.75
"""Lower limit of a frequency with overtones, relative to that of the best sinusoid without them."""
SPECTRUM_PADDING = 8
"""The spectrum is evaluated at 1/8 of its natural spacing, so that the search starts inside the main lobe."""


@dataclass(frozen=True, slots=True)
class SineFit:
    """``offset + amplitude·sin(2π·frequency_hz·t + phase_rad)`` plus overtones; t = 0 at the first sample.

    A constant has frequency 0 and amplitude 0. ``overtones`` holds (amplitude, phase) of the fitted harmonics
    2, 3, …; ``residual_rms`` is the RMS residual of the fit.
    """

    frequency_hz: float
    amplitude: float
    offset: float
    phase_rad: float
    residual_rms: float
    overtones: tuple[tuple[float, float], ...] = ()

    @property
    def distortion(self) -> float:
        """Total harmonic distortion, overtones over fundamental in amplitude (RMS); 0 for a constant."""
        if self.amplitude == 0:
            return 0.0
        return (
            float(np.hypot.reduce([amplitude for amplitude, _ in self.overtones] or [0.0])) / self.amplitude
        )

    def at(self, times_s: NDArray[Any]) -> NDArray[np.float64]:
        """Evaluate the fitted curve at times in seconds after the first sample."""
        terms = ((self.amplitude, self.phase_rad), *self.overtones)
        values = np.full(np.shape(times_s), self.offset, np.float64)
        for k, (amplitude, phase) in enumerate(terms, start=1):
            values += amplitude * np.sin(2 * np.pi * k * self.frequency_hz * times_s + phase)
        return values


@dataclass(frozen=True, slots=True)
class CurveComparison:
    """Comparison of a region's measured intensity with the theoretical one.

    ``correlation`` is Pearson's, None if either curve is constant; ``rms_error`` and the fits are in the
    units of the scene; ``level_ratio`` is the ratio of the means, measured over theory.
    """

    name: str
    theory: SineFit
    measured: SineFit
    correlation: float | None
    level_ratio: float | None
    rms_error: float

    @property
    def constant(self) -> bool:
        """Whether the region is constant in theory, so that its frequency and amplitude mean nothing."""
        return self.theory.amplitude == 0

    @property
    def amplitude_ratio(self) -> float | None:
        """Measured over theoretical amplitude of the fundamental; below 1 if part of the swing was lost."""
        return None if self.constant else self.measured.amplitude / self.theory.amplitude

    @property
    def frequency_error_hz(self) -> float | None:
        """Measured minus theoretical frequency; None for a region that is constant in theory."""
        return None if self.constant else self.measured.frequency_hz - self.theory.frequency_hz


def region_mean(video: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the mean (t,) over the pixels of ``mask`` (row, column) in each frame of ``video`` (t, row,
    column).

    Raises UsageError for a mask of another shape or without pixels.
    """
    # NumPy would take a mask of integers for the numbers of frames and pixels.
    if video.ndim != 3 or mask.shape != video.shape[1:] or mask.dtype != np.bool_ or not mask.any():
        mask_text = f"{np.count_nonzero(mask)} pixels of a {mask.dtype} mask {mask.shape}"
        raise UsageError(
            f"a video {video.shape} has no mean over {mask_text}",
            possible="a boolean mask of the frame's shape with at least one pixel",
        )
    means: NDArray[np.float64] = video[:, mask].mean(axis=1, dtype=np.float64)
    return means


def fit_sine(
    values: NDArray[Any],
    interval_s: float,
    *,
    frequency_hz: float | None = None,
    guess_hz: float | None = None,
    harmonics: int = 1,
) -> SineFit:
    """Fit a sinusoid to ``values`` (t,), sampled every ``interval_s`` seconds, by least squares.

    The frequency is ``frequency_hz`` if given; otherwise it is searched around ``guess_hz``, or around the
    highest peak of the spectrum. Harmonics at or above half the sampling rate are left out. Raises UsageError
    for too few samples or a frequency that they cannot resolve, NumericsError for values that are not finite.
    """
    values = np.asarray(values, np.float64)
    _check_curve(values, interval_s, harmonics)
    times_s = np.arange(len(values), dtype=np.float64) * np.float64(interval_s)
    # The spectrum of a constant is rounding alone, and any sinusoid fits it.
    if frequency_hz is None and np.ptp(values) <= CONSTANT_SWING * np.abs(values).max():
        return fit_constant(values)
    if frequency_hz is None:
        if guess_hz is None:
            size = SPECTRUM_PADDING * len(values)
            # Without the mean, whose peak at frequency 0 would reach over all others.
            spectrum = np.abs(np.fft.rfft(values - values.mean(), size))
            # Without its ends: no sinusoid of frequency 0, or of half the sampling rate, can be fitted.
            guess_hz = (1 + int(np.argmax(spectrum[1:-1]))) / (size * interval_s)
        frequency_hz, harmonics = _refine(values, times_s, guess_hz, harmonics)
    else:
        harmonics = _visible_harmonics(frequency_hz, interval_s, harmonics)
    coefficients, residual = _project(values, times_s, frequency_hz, harmonics)
    p, q = coefficients[1::2], coefficients[2::2]
    # p·sin x + q·cos x = √(p² + q²)·sin(x + atan2(q, p))
    terms = [(float(a), float(phase)) for a, phase in zip(np.hypot(p, q), np.arctan2(q, p), strict=True)]
    (amplitude, phase_rad), *overtones = terms
    rms = float(np.sqrt(np.mean(np.square(residual))))
    return SineFit(
        frequency_hz=frequency_hz,
        amplitude=amplitude,
        offset=float(coefficients[0]),
        phase_rad=phase_rad,
        residual_rms=rms,
        overtones=tuple(overtones),
    )


def fit_constant(values: NDArray[Any]) -> SineFit:
    """Fit a constant: frequency and amplitude are 0, and the residual is the ripple."""
    values = np.asarray(values, np.float64)
    return SineFit(0.0, 0.0, float(values.mean()), 0.0, float(values.std()))


def compare_curve(
    name: str, theory: NDArray[Any], measured: NDArray[Any], interval_s: float, harmonics: int = HARMONICS
) -> CurveComparison:
    """Fit both curves (t,) and compare them. If theory is constant, a constant is fitted to both.

    Raises UsageError for different lengths, and as :func:`fit_sine`.
    """
    theory, measured = np.asarray(theory, np.float64), np.asarray(measured, np.float64)
    if theory.shape != measured.shape:
        raise UsageError(
            f"a curve {measured.shape} cannot be compared with a theory {theory.shape}",
            possible="curves of the same length",
        )
    # a constant has no correlation: numpy would divide 0 by 0
    swing = all(np.ptp(curve) > CONSTANT_SWING * np.abs(curve).max() for curve in (theory, measured))
    # theory decides whether a curve changes: noise alone always fits some sinusoid
    theory_fit = fit_sine(theory, interval_s, harmonics=harmonics)
    check_finite(measured, "the measured curve")
    return CurveComparison(
        name=name,
        theory=theory_fit,
        measured=fit_sine(measured, interval_s, harmonics=harmonics)
        if theory_fit.amplitude
        else fit_constant(measured),
        correlation=float(np.corrcoef(theory, measured)[0, 1]) if swing else None,
        level_ratio=float(measured.mean() / theory.mean()) if theory.mean() else None,
        rms_error=float(np.sqrt(np.mean(np.square(measured - theory)))),
    )


def _check_curve(values: NDArray[np.float64], interval_s: float, harmonics: int) -> None:
    # the unknowns: an offset, the frequency, and two for each harmonic
    least = 2 * harmonics + 2
    if values.ndim != 1 or harmonics < 1 or len(values) < least:
        raise UsageError(
            f"a sinusoid with {harmonics} harmonics cannot be fitted to {values.shape} values",
            possible=f"a curve (t,) of at least {least} values, and 1 harmonic or more",
        )
    if not (np.isfinite(interval_s) and interval_s > 0):
        raise UsageError(
            f"the sampling interval cannot be {interval_s} s", possible="a positive number of seconds"
        )
    check_finite(values, "the curve")


def _visible_harmonics(frequency_hz: float, interval_s: float, harmonics: int) -> int:
    """Return the number of harmonics below half the sampling rate. Raises UsageError if there is none."""
    nyquist_hz = 0.5 / interval_s
    # At half the sampling rate itself every sample of a sine can be 0, which leaves its amplitude open.
    if not 0 < frequency_hz < nyquist_hz:
        raise UsageError(
            f"a sinusoid of {frequency_hz} Hz cannot be fitted to samples every {interval_s:g} s",
            possible=f"above 0 and below {nyquist_hz:g} Hz",
        )
    # Of a whole ratio one less: that harmonic would be at half the sampling rate.
    return min(harmonics, int(np.ceil(nyquist_hz / frequency_hz)) - 1)


def _refine(
    values: NDArray[np.float64], times_s: NDArray[np.float64], start_hz: float, harmonics: int
) -> tuple[float, int]:
    """Return the frequency with the smallest residual within a lobe of ``start_hz``, and the harmonics."""
    interval_s = times_s[1]
    harmonics = _visible_harmonics(start_hz, interval_s, harmonics)
    lobe_hz = 1 / (len(values) * interval_s)
    # not down to 0, where sine, cosine and offset become one
    low_hz = max(start_hz - lobe_hz, 0.25 * lobe_hz)
    high_hz = min(start_hz + lobe_hz, 0.5 / interval_s)

    def best(low_hz: float, high_hz: float, harmonics: int) -> float:
        found = minimize_scalar(
            lambda f: float(np.sum(np.square(_project(values, times_s, f, harmonics)[1]))),
            bounds=(low_hz, high_hz),
            method="bounded",
            options={"xatol": 1e-7 * lobe_hz},
        )
        return float(found.x)

    if harmonics > 1 and low_hz < LOWEST * start_hz:
        # Of one or two periods half the frequency is within the lobe, where the second harmonic fits as well
        # as the fundamental.
        low_hz = max(low_hz, LOWEST * best(low_hz, high_hz, 1))
    return best(low_hz, high_hz, harmonics), harmonics


def _project(
    values: NDArray[np.float64], times_s: NDArray[np.float64], frequency_hz: float, harmonics: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the coefficients (offset, p_1, q_1, p_2, …) of the fit at a frequency, and the residual (t,)."""
    angle = 2 * np.pi * frequency_hz * times_s
    columns = [np.ones_like(angle)]
    for k in range(1, harmonics + 1):
        columns += [np.sin(k * angle), np.cos(k * angle)]
    design = np.stack(columns, axis=1)
    # lstsq, since towards frequency 0 the columns become dependent on each other.
    coefficients = np.linalg.lstsq(design, values, rcond=None)[0].astype(np.float64, copy=False)
    return coefficients, values - design @ coefficients
