"""A result is consistent, and its summary survives JSON."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from acquire.errors import UsageError
from acquire.evaluate.report import DemoResult, evaluate_solver
from acquire.evaluate.summary import rounded, summarise


def test_time_axes_count_from_the_start_of_the_run(result: DemoResult) -> None:
    assert result.frame_ms[:2] == pytest.approx([52.0, 52.01])
    assert result.line_ms[[0, -1]] == pytest.approx([52.0, 53.5])
    assert result.frame_interval_us == pytest.approx(10)


def test_summary_survives_json_and_holds_what_was_measured(result: DemoResult) -> None:
    summary = summarise(result)
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["total_s"] == 43.24
    assert summary["when"] == "2025-06-07T08:09:10+00:00"
    assert summary["rig"]["line_rate_khz"] == 33.33
    assert summary["rig"]["substep_rate_khz"] == 100.0
    assert summary["capture"]["recorded_lines"] == 2 * 20_003 - 16
    assert summary["capture"]["lost_lines"] == 16
    assert summary["capture"]["arms"]["b"]["lost"] == {"camera": 2, "ring_full": 14}
    assert summary["segment"]["masked_samples"] == 16
    assert summary["segment"]["frames"] == 130
    best, other = summary["solvers"]
    # the noise and the damping that the fixture put in
    assert best["psnr_db"] == pytest.approx(20 * np.log10(result.peak / 0.011), abs=0.1)
    assert [solver["stopped_by_budget_s"] for solver in (best, other)] == [None, 31.5]
    assert [solver["requested_iterations"] for solver in (best, other)] == [118, 451]
    assert other["psnr_db"] < 18 < best["worst_frame_psnr_db"] < best["psnr_db"]
    assert [curve["amplitude_ratio"] for curve in other["curves"]] == [
        pytest.approx(0.8, abs=0.03),
        pytest.approx(0.8, abs=0.03),
        None,
    ]
    assert [curve["set_hz"] for curve in best["curves"]] == [5000.0, 2500.0, None]


def test_samples_per_voxel_are_the_papers_sampling_rate(result: DemoResult) -> None:
    rate = result.segment.geometry.sampling_rate()
    assert summarise(result)["segment"]["samples_per_100_voxels"] == pytest.approx(100 * rate, abs=0.006)


@pytest.mark.parametrize(("value", "expected"), [(None, None), (np.inf, None), (np.nan, None), (1.256, 1.26)])
def test_rounding_leaves_only_what_json_can_hold(value, expected) -> None:
    assert rounded(value, 2) == expected


def test_rounding_gives_no_negative_zero() -> None:
    assert str(rounded(-0.001, 2)) == "0.0"


def test_the_evaluation_of_the_truth_itself_is_perfect(result: DemoResult) -> None:
    perfect = evaluate_solver(
        "truth",
        result.truth,
        result.truth,
        result.regions,
        1e-5,
        seconds=0.0,
        iterations=0,
        requested_iterations=0,
    )
    assert perfect.psnr_db == np.inf
    assert perfect.ssim == pytest.approx(1)
    assert [curve.amplitude_ratio for curve in perfect.curves] == [
        pytest.approx(1, abs=1e-5),
        pytest.approx(1, abs=1e-5),
        None,
    ]


class TestRefusals:
    def test_time_stamps_of_another_length(self, result: DemoResult) -> None:
        with pytest.raises(UsageError, match="129 time stamps"):
            replace(result, frame_time_ns=result.frame_time_ns[1:])

    def test_no_solver(self, result: DemoResult) -> None:
        with pytest.raises(UsageError, match="needs a reconstruction"):
            replace(result, solvers=())

    def test_a_video_of_another_size(self, result: DemoResult) -> None:
        odd = replace(result.solvers[1], video=result.solvers[1].video[:, 1:])
        with pytest.raises(UsageError, match="'TwIST'"):
            replace(result, solvers=(result.solvers[0], odd))

    def test_curves_of_other_regions(self, result: DemoResult) -> None:
        with pytest.raises(UsageError, match="'ADMM"):
            replace(result, regions=result.regions[::-1])

    def test_a_theory_of_another_length(self, result: DemoResult) -> None:
        odd = replace(result.regions[0], theory=result.regions[0].theory[:-1])
        with pytest.raises(UsageError, match="'fast'"):
            replace(result, regions=(odd, *result.regions[1:]))

    def test_a_missing_ledger(self, result: DemoResult) -> None:
        capture = replace(result.capture, arms={"a": result.capture.arms["a"]})
        with pytest.raises(UsageError, match="ledgers"):
            replace(result, capture=capture)
