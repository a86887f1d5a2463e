"""The demo's second half: cut, reconstruct by both solvers, compare with the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from acquire.cli.progress import stage_progress
from acquire.config import LedSceneConfig, SineDrive
from acquire.evaluate.report import (
    ArmLedger,
    CaptureFacts,
    DemoResult,
    Region,
    RigFacts,
    SolverResult,
    evaluate_solver,
)
from acquire.recon import Reconstruction, reconstruct
from acquire.reconstruct import save_reconstruction
from acquire.sim.scenes import LedScene, build_scene
from acquire.sim.voxels import truth
from acquire.store import Recording, open_recording, write_video

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.cli.demo import Journal
    from acquire.cli.demo_capture import Captured
    from acquire.config import RigConfig
    from acquire.daemon.messages import ArmStatus
    from acquire.lines import Segment

N_M, T_M = 3, 1
"""Fig. 9: 64 × 64 voxels at the sub-step rate."""

INNER = 0.9
"""Regions hold the voxels that a shape covers at least so far: edges mix light and dark."""


def analyse(
    out: Path,
    captured: Captured,
    rig: RigConfig,
    journal: Journal,
    seed: int,
    command: str,
    budgets: tuple[float | None, float],
) -> DemoResult:
    """Everything that the report shows; leaves truth and videos in ``out``."""
    from acquire.cli.demo import SEGMENT_LINES, SEGMENT_START_S

    recording = open_recording(captured.path)
    with journal.stage("Cut both arms") as note:
        first = recording.first_line + round(SEGMENT_START_S * rig.line_rate_hz)
        segment = recording.cut(first, SEGMENT_LINES)
        note["detail"] = f"lines {first} to {first + SEGMENT_LINES - 1}"
    with journal.stage("Save the truth at full resolution"):
        scene = _scene(recording, segment)
        _save_truth(out / "truth.zarr", scene, segment)
    default = _solve("admm", "Reconstruct: ADMM (default)", segment, budgets[0], journal)
    paper = _solve("twist", "Reconstruct: TwIST (the paper's)", segment, budgets[1], journal)
    for name, result in (("video", default), ("video-twist", paper)):
        save_reconstruction(out / f"{name}.zarr", result, recording, segment, N_M)
    trusted = default.trusted
    voxels = truth(scene, _first_substep(segment), segment.geometry.span, N_M, T_M)[trusted]
    regions = _regions(scene, segment, trusted)
    with journal.stage("Compare with the truth"):
        interval_s = segment.substep_ns * T_M * 1e-9
        solvers = tuple(
            _judge(label, result, voxels, regions, interval_s)
            for label, result in (("ADMM (default)", default), ("TwIST (the paper's)", paper))
        )
    return DemoResult(
        title=str(recording.attrs["scene"]["title"]),
        when=journal.when,
        command=command,
        seed=seed,
        rig=_rig_facts(recording),
        capture=_capture_facts(recording, captured),
        segment=segment,
        start_ns=int(np.asarray(recording.camera("a").time_ns[:1])[0]),
        frame_time_ns=default.time_ns[trusted],
        truth=voxels,
        solvers=solvers,
        regions=regions,
        stages=tuple(journal.stages),
    )


def _solve(
    solver: Literal["admm", "twist"], name: str, segment: Segment, budget_s: float | None, journal: Journal
) -> Reconstruction:
    with journal.stage(name) as note, stage_progress(name) as advance:
        result = reconstruct(
            segment,
            N_M,
            T_M,
            budget_s=budget_s,
            progress=lambda step: advance(step.iteration, step.iterations),
            solver=solver,
        )
        note["detail"] = f"{result.iterations} iterations"
    return result


def _judge(
    label: str,
    result: Reconstruction,
    voxels: NDArray[np.float32],
    regions: tuple[Region, ...],
    interval_s: float,
) -> SolverResult:
    video = result.video[result.trusted]
    return evaluate_solver(
        label, video, voxels, regions, interval_s, seconds=result.seconds, iterations=result.iterations
    )


def _scene(recording: Recording, segment: Segment) -> LedScene:
    """The scene as the recording describes it, not as this process remembers it."""
    config = LedSceneConfig.model_validate(recording.attrs["scene"])
    scene = build_scene(config, segment.geometry.size, segment.substep_ns * 1e-9)
    assert isinstance(scene, LedScene)
    return scene


def _first_substep(segment: Segment) -> int:
    return segment.geometry.substeps * segment.first_line


def _save_truth(path: Path, scene: LedScene, segment: Segment) -> None:
    """What the lines of the segment saw: every sub-step at full resolution."""
    frames = scene.frames(_first_substep(segment), segment.geometry.span)
    provenance = {"first_substep": _first_substep(segment), "first_line": segment.first_line}
    write_video(path, frames, segment.frame_time_ns(), 1.0, segment.substep_ns, provenance, pixel_unit=None)


def _regions(scene: LedScene, segment: Segment, trusted: slice) -> tuple[Region, ...]:
    """One region per LED; theory is its light in the voxels wholly behind its mask."""
    first = _first_substep(segment) + trusted.start
    light = scene.intensity(first, trusted.stop - trusted.start)
    side = scene.size // N_M
    covered = scene.masks.reshape(-1, side, N_M, side, N_M).mean(axis=(2, 4))
    regions = []
    for led, mask, curve in zip(scene.leds, covered, light, strict=True):
        inner = mask >= INNER
        set_hz = led.drive.frequency_hz if isinstance(led.drive, SineDrive) else None
        regions.append(Region(led.name, inner, curve * float(mask[inner].mean()), set_hz))
    return tuple(regions)


def _rig_facts(recording: Recording) -> RigFacts:
    attrs: dict[str, Any] = recording.attrs
    code = attrs["code"]
    text = ", ".join(f"{key} {value}" for key, value in code.items() if key not in {"kind", "start"})
    return RigFacts(
        name=str(attrs["config"]["name"]),
        code=f"{code['kind']} ({text})",
        scene=str(attrs["scene"]["title"]),
        simulated=bool(attrs["simulated"]),
    )


def _capture_facts(recording: Recording, captured: Captured) -> CaptureFacts:
    return CaptureFacts(
        recording=captured.path,
        condition=str(recording.attrs["run_condition"]),
        end_reason=str(recording.attrs["end_reason"]),
        seconds=captured.seconds,
        size_bytes=int(recording.info()["bytes"]),
        arms={name: _ledger(arm) for name, arm in captured.status.arms.items()},
    )


def _ledger(arm: ArmStatus) -> ArmLedger:
    return ArmLedger(
        delivered=arm.delivered,
        preroll=arm.preroll,
        recorded=arm.recorded,
        missing=arm.missing,
        ring_peak=arm.ring.peak,
        ring_slots=arm.ring.slots,
        lost=arm.lost,
    )
