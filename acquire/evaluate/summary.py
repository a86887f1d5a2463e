"""The numbers of a demo run, rounded once, for the page, ``summary.json`` and ``--json`` alike.

All values can be written as JSON, and their names include the unit. None stands for values that do not exist,
such as the frequency of a constant, and for values that are not finite, such as the PSNR of equal videos.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from datetime import UTC
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.lines import ARMS

if TYPE_CHECKING:
    from acquire.evaluate.curves import CurveComparison
    from acquire.evaluate.result import ArmAccount, CaptureFacts, DemoResult, SolverResult


def summarise(result: DemoResult) -> dict[str, Any]:
    """Return all numbers of the report."""
    set_hz = [region.set_hz for region in result.regions]
    return {
        "title": result.title,
        "when": result.when.astimezone(UTC).isoformat(timespec="seconds"),
        "command": result.command,
        "seed": result.seed,
        "host": result.host.facts(),
        "total_s": rounded(sum(stage.seconds for stage in result.stages), 2),
        "stages": [{**asdict(stage), "seconds": rounded(stage.seconds, 2)} for stage in result.stages],
        "rig": rig_summary(result),
        "capture": capture_summary(result.capture),
        "segment": segment_summary(result),
        "solvers": [solver_summary(solver, set_hz) for solver in result.solvers],
    }


def rig_summary(result: DemoResult) -> dict[str, Any]:
    rig, geometry, substep_ns = result.rig, result.segment.geometry, result.segment.substep_ns
    return {
        "name": rig.name,
        "scene": rig.scene,
        "simulated": rig.simulated,
        "code": rig.code,
        "stages": geometry.stages,
        "substeps": geometry.substeps,
        "substep_us": rounded(substep_ns / 1e3, 3),
        "substep_rate_khz": rounded(1e6 / substep_ns, 2),
        "line_rate_khz": rounded(1e6 / (substep_ns * geometry.substeps), 2),
    }


def capture_summary(capture: CaptureFacts) -> dict[str, Any]:
    """Summarise a capture; ``recorded_lines`` and ``lost_lines`` are sums over both arms."""
    ledgers = capture.arms.values()
    return {
        "recording": str(capture.recording),
        "condition": capture.condition,
        "end_reason": capture.end_reason,
        "seconds": rounded(capture.seconds, 2),
        "size_mb": rounded(capture.size_bytes / 1e6, 2),
        "recorded_lines": sum(ledger.recorded - ledger.missing for ledger in ledgers),
        "lost_lines": sum(ledger.lost_lines for ledger in ledgers),
        "arms": {arm: ledger_summary(capture.arms[arm]) for arm in ARMS},
    }


def ledger_summary(ledger: ArmAccount) -> dict[str, Any]:
    """Summarise one arm's account of its lines since arming."""
    return {
        "delivered": ledger.delivered,
        "preroll": ledger.preroll,
        "discarded": ledger.discarded,
        "recorded": ledger.recorded,
        "missing": ledger.missing,
        # JSON has no other keys than texts.
        "lost": {str(cause): lines for cause, lines in ledger.lost.items()},
        "ring_peak": ledger.ring_peak,
        "ring_slots": ledger.ring_slots,
    }


def segment_summary(result: DemoResult) -> dict[str, Any]:
    segment, truth = result.segment, result.truth
    return {
        "first_line": segment.first_line,
        "lines": segment.geometry.lines,
        "masked_samples": int(segment.mask.size - np.count_nonzero(segment.mask)),
        "line_ms": [rounded(ms, 3) for ms in result.line_ms[[0, -1]]],
        "frames": truth.shape[0],
        "frame_size": list(truth.shape[1:]),
        "frame_ms": [rounded(ms, 3) for ms in result.frame_ms[[0, -1]]],
        "frame_interval_us": rounded(result.frame_interval_us, 3),
        "samples_per_100_voxels": rounded(100 * segment.lines.size / span_voxels(result), 2),
    }


def span_voxels(result: DemoResult) -> float:
    """Return the number of voxels of the segment's whole span T, as S_r counts all of T."""
    span_us = result.segment.geometry.span * result.segment.substep_ns / 1e3
    rows, columns = result.truth.shape[1:]
    return float(rows * columns) * span_us / result.frame_interval_us


def solver_summary(solver: SolverResult, set_hz: list[float | None]) -> dict[str, Any]:
    """Summarise a solver's result; ``set_hz`` are the frequencies that its curves' regions were driven at."""
    return {
        "label": solver.label,
        "seconds": rounded(solver.seconds, 2),
        "iterations": solver.iterations,
        "requested_iterations": solver.requested_iterations,
        # With all of its iterations, a solver has not been stopped, however small the budget.
        "stopped_by_budget_s": solver.budget_s if solver.iterations < solver.requested_iterations else None,
        "psnr_db": rounded(solver.psnr_db, 2),
        "worst_frame_psnr_db": rounded(solver.psnr_per_frame.min(), 2),
        "ssim": rounded(solver.ssim, 3),
        "curves": [curve_summary(curve, hz) for curve, hz in zip(solver.curves, set_hz, strict=True)],
    }


def curve_summary(curve: CurveComparison, set_hz: float | None) -> dict[str, Any]:
    return {
        "name": curve.name,
        "set_hz": set_hz,
        **swing_summary(curve),
        "level_ratio": rounded(curve.level_ratio, 3),
        "correlation": rounded(curve.correlation, 3),
        "rms_error": rounded(curve.rms_error, 4),
    }


def swing_summary(curve: CurveComparison) -> dict[str, float | None]:
    """Return the numbers that only a changing curve has; all are None if theory is constant."""
    values = {
        "measured_hz": rounded(curve.measured.frequency_hz, 1),
        "frequency_error_hz": rounded(curve.frequency_error_hz, 1),
        "theory_amplitude": rounded(curve.theory.amplitude, 3),
        "measured_amplitude": rounded(curve.measured.amplitude, 3),
        "amplitude_ratio": rounded(curve.amplitude_ratio, 3),
        "theory_distortion_percent": rounded(100 * curve.theory.distortion, 1),
        "measured_distortion_percent": rounded(100 * curve.measured.distortion, 1),
    }
    # With all its keys, so that the columns of a page and of a table do not depend on the curve.
    return dict.fromkeys(values) if curve.constant else values


def rounded(value: float | None, digits: int) -> float | None:
    """Round a value, without a negative zero; None for None and for values that are not finite."""
    if value is None or not math.isfinite(value):
        return None
    # −0.0 + 0.0 is 0.0
    return round(float(value), digits) + 0.0
