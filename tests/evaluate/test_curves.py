"""Sinusoids in a region of a video: mean, fit and comparison, against curves whose parameters are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from acquire.errors import NumericsError, UsageError
from acquire.evaluate.curves import compare_curve, fit_constant, fit_sine, region_mean

INTERVAL_S = 1e-5
FRAMES = 598
TIMES_S = np.arange(FRAMES) * INTERVAL_S
LOBE_HZ = 1 / (FRAMES * INTERVAL_S)


def sine(hz: float, amplitude: float = 0.4, offset: float = 0.5, phase: float = 0.3) -> np.ndarray:
    return offset + amplitude * np.sin(2 * np.pi * hz * TIMES_S + phase)


def saturated(hz: float) -> np.ndarray:
    """The LED driven too far: flat above, with even and odd overtones."""
    return np.tanh(2 * sine(hz, 0.475, 0.525))


class TestRegionMean:
    def test_is_the_mean_over_the_mask_in_double(self) -> None:
        video = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
        mask = np.zeros((3, 4), bool)
        mask[0, 1] = mask[2, 3] = True
        means = region_mean(video, mask)
        assert means.dtype == np.float64
        assert means.tolist() == [6.0, 18.0]

    @pytest.mark.parametrize(
        "mask",
        [np.zeros((3, 4), bool), np.ones((4, 3), bool), np.ones((3, 4), int)],
        ids=["empty", "shape", "int"],
    )
    def test_refuses_a_mask_that_selects_nothing_sensible(self, mask) -> None:
        with pytest.raises(UsageError, match="mask"):
            region_mean(np.ones((2, 3, 4)), mask)


class TestFitSine:
    @pytest.mark.parametrize("hz", [1000.0, 2500.0, 5000.0, 1.5 * LOBE_HZ, 49_000.0])
    def test_recovers_an_exact_sinusoid_of_a_6_ms_window(self, hz) -> None:
        fit = fit_sine(sine(hz), INTERVAL_S)
        assert fit.frequency_hz == pytest.approx(hz, abs=1e-3)
        assert (fit.amplitude, fit.offset, fit.phase_rad) == pytest.approx((0.4, 0.5, 0.3), abs=1e-5)
        assert fit.residual_rms < 1e-6
        np.testing.assert_allclose(fit.at(TIMES_S), sine(hz), atol=1e-5)

    @settings(deadline=None, max_examples=60)
    @given(
        hz=st.floats(2 * LOBE_HZ, 0.45 / INTERVAL_S),
        amplitude=st.floats(1e-3, 1e3),
        offset=st.floats(-10, 10),
        phase=st.floats(-3.1, 3.1),
    )
    def test_recovers_any_sinusoid(self, hz, amplitude, offset, phase) -> None:
        fit = fit_sine(sine(hz, amplitude, offset, phase), INTERVAL_S)
        assert fit.frequency_hz == pytest.approx(hz, abs=1e-2)
        assert fit.amplitude == pytest.approx(amplitude, rel=1e-3)
        assert np.exp(1j * fit.phase_rad) == pytest.approx(np.exp(1j * phase), abs=1e-3)

    def test_noise_stays_near_the_cramer_rao_bound(self) -> None:
        rng = np.random.default_rng(0)
        sigma, amplitude = 0.1, 0.4
        bound_hz = np.sqrt(24) * sigma / (2 * np.pi * amplitude * FRAMES**1.5 * INTERVAL_S)
        fits = [
            fit_sine(sine(2500, amplitude) + sigma * rng.standard_normal(FRAMES), INTERVAL_S)
            for _ in range(40)
        ]
        errors_hz = np.array([fit.frequency_hz - 2500 for fit in fits])
        assert 0.7 * bound_hz < errors_hz.std() < 1.4 * bound_hz
        assert abs(errors_hz.mean()) < bound_hz
        assert np.mean([fit.residual_rms for fit in fits]) == pytest.approx(sigma, rel=0.05)

    def test_overtones_are_those_of_the_fourier_series(self) -> None:
        hz = 1000.0
        fine = np.arange(100_000) / 100_000
        wave = np.tanh(2 * (0.525 + 0.475 * np.sin(2 * np.pi * fine + 0.3)))
        series = [2 * abs(np.mean(wave * np.exp(-2j * np.pi * k * fine))) for k in (1, 2, 3)]
        fit = fit_sine(saturated(hz), INTERVAL_S, harmonics=3)
        assert fit.frequency_hz == pytest.approx(hz, abs=0.5)
        assert [fit.amplitude, *(a for a, _ in fit.overtones)] == pytest.approx(series, abs=2e-3)
        assert fit.distortion == pytest.approx(np.hypot(*series[1:]) / series[0], rel=0.02)
        np.testing.assert_allclose(fit.at(TIMES_S), saturated(hz), atol=0.02)

    @pytest.mark.parametrize("periods", [0.9, 1.0, 1.2, 1.5])
    @pytest.mark.parametrize("phase", [0.3, 2.0, 4.5])
    def test_one_period_is_not_taken_for_the_second_harmonic_of_half_the_frequency(
        self, periods, phase
    ) -> None:
        noise = 0.005 * np.random.default_rng(1).standard_normal(FRAMES)
        for curve in (sine(periods * LOBE_HZ, phase=phase), saturated(periods * LOBE_HZ)):
            fit = fit_sine(curve + noise, INTERVAL_S, harmonics=3)
            assert fit.frequency_hz == pytest.approx(periods * LOBE_HZ, rel=0.05)

    def test_a_pure_sinusoid_is_not_distorted(self) -> None:
        assert fit_sine(sine(5000), INTERVAL_S, harmonics=3).distortion < 1e-6

    def test_harmonics_above_half_the_sampling_rate_are_left_out(self) -> None:
        assert len(fit_sine(sine(20_000), INTERVAL_S, harmonics=3).overtones) == 1
        assert fit_sine(sine(30_000), INTERVAL_S, harmonics=3).overtones == ()

    def test_a_given_frequency_is_kept(self) -> None:
        fit = fit_sine(sine(1000) + sine(2500, 0.1, 0), INTERVAL_S, frequency_hz=2500)
        assert fit.frequency_hz == 2500
        assert fit.amplitude == pytest.approx(0.1, rel=0.05)

    def test_a_guess_chooses_among_several_sinusoids(self) -> None:
        both = sine(1000) + sine(5000, 0.1, 0)
        assert fit_sine(both, INTERVAL_S).frequency_hz == pytest.approx(1000, abs=5)
        assert fit_sine(both, INTERVAL_S, guess_hz=4950).frequency_hz == pytest.approx(5000, abs=5)

    @pytest.mark.parametrize("level", [0.0, 0.7, -3.0])
    def test_a_constant_is_the_sinusoid_of_frequency_0(self, level) -> None:
        fit = fit_sine(np.full(FRAMES, level), INTERVAL_S, harmonics=3)
        assert (fit.frequency_hz, fit.amplitude, fit.residual_rms) == pytest.approx((0, 0, 0), abs=1e-12)
        assert fit.offset == pytest.approx(level)
        np.testing.assert_allclose(fit.at(TIMES_S), level)
        assert fit.distortion == 0

    def test_the_ripple_of_a_constant_is_its_residual(self) -> None:
        values = np.array([1.0, 3.0, 1.0, 3.0])
        assert fit_constant(values).residual_rms == 1
        assert fit_constant(values).offset == 2

    def test_refusals(self) -> None:
        with pytest.raises(UsageError, match="at least 8"):
            fit_sine(np.arange(7.0), INTERVAL_S, harmonics=3)
        with pytest.raises(UsageError, match="interval"):
            fit_sine(sine(1000), 0.0)
        with pytest.raises(UsageError, match="below 50000 Hz"):
            fit_sine(sine(1000), INTERVAL_S, frequency_hz=50_000)
        with pytest.raises(NumericsError, match="curve"):
            fit_sine(np.where(TIMES_S > 1e-3, np.nan, 1.0), INTERVAL_S)


class TestCompareCurve:
    @settings(deadline=None, max_examples=30)
    @given(ratio=st.floats(0.05, 2), shift=st.floats(-0.2, 0.5))
    def test_finds_a_lost_amplitude_whatever_the_level(self, ratio, shift) -> None:
        assume(0.5 + shift > 0.01)
        comparison = compare_curve("x", sine(2500), sine(2500, 0.4 * ratio, 0.5 + shift), INTERVAL_S)
        assert comparison.amplitude_ratio == pytest.approx(ratio, rel=1e-4)
        assert comparison.frequency_error_hz == pytest.approx(0, abs=0.01)
        assert comparison.correlation == pytest.approx(1, abs=1e-6)
        assert not comparison.constant

    def test_finds_a_wrong_frequency(self) -> None:
        comparison = compare_curve("x", sine(2500), sine(2512.5), INTERVAL_S)
        assert comparison.frequency_error_hz == pytest.approx(12.5, abs=0.01)
        assert comparison.correlation is not None
        assert comparison.correlation < 1

    def test_a_curve_in_opposite_phase_has_the_amplitude_but_not_the_correlation(self) -> None:
        comparison = compare_curve("x", sine(2500), sine(2500, -0.4), INTERVAL_S)
        assert comparison.amplitude_ratio == pytest.approx(1)
        assert comparison.correlation == pytest.approx(-1)

    def test_noise_on_a_constant_is_not_taken_for_a_sinusoid(self) -> None:
        noisy = 0.6 + 0.01 * np.random.default_rng(1).standard_normal(FRAMES)
        comparison = compare_curve("equals", np.full(FRAMES, 0.75), noisy, INTERVAL_S)
        assert comparison.constant
        assert (comparison.amplitude_ratio, comparison.frequency_error_hz, comparison.correlation) == (
            None,
        ) * 3
        assert comparison.level_ratio == pytest.approx(0.8, rel=0.01)
        assert comparison.measured.residual_rms == pytest.approx(0.01, rel=0.1)
        assert comparison.rms_error == pytest.approx(0.15, rel=0.02)

    def test_a_completely_lost_oscillation_has_ratio_0(self) -> None:
        comparison = compare_curve("x", sine(2500), np.full(FRAMES, 0.5), INTERVAL_S)
        assert comparison.amplitude_ratio == 0
        assert comparison.correlation is None

    def test_a_dark_theory_has_no_level_ratio(self) -> None:
        assert compare_curve("x", np.zeros(FRAMES), sine(2500), INTERVAL_S).level_ratio is None

    def test_refusals(self) -> None:
        with pytest.raises(UsageError, match=r"\(597,\)"):
            compare_curve("x", sine(2500), sine(2500)[1:], INTERVAL_S)
        with pytest.raises(NumericsError, match="measured"):
            compare_curve("x", np.ones(FRAMES), np.full(FRAMES, np.nan), INTERVAL_S)
