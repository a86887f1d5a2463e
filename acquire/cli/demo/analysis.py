"""The demo's second half: cut the lines, reconstruct them with both solvers, compare with the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from acquire.cli.demo.plan import N_M, SEGMENT_LINES, T_M, segment_row
from acquire.cli.progress import stage_progress
from acquire.config.scene import SineDrive
from acquire.evaluate.host import HostWatch
from acquire.evaluate.report import (
    ArmAccount,
    CaptureFacts,
    DemoResult,
    Region,
    RigFacts,
    evaluate_solver,
)
from acquire.loops import how_often
from acquire.recon import Reconstruction, reconstruct
from acquire.reconstruct import save_reconstruction
from acquire.sim.leds import LedScene, LedSceneConfig
from acquire.sim.scenes import build_scene
from acquire.sim.voxels import truth
from acquire.store import Recording, open_recording, write_video
from acquire.text import counted

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.cli.demo.capture import Captured
    from acquire.cli.demo.plan import DemoPlan
    from acquire.cli.journal import StepJournal
    from acquire.config import RigConfig
    from acquire.lines import Segment

INNER = 0.9
"""Share of a voxel that a shape must cover to be in its region: voxels on edges mix light and dark."""
REPORTED_S = 1.0
"""A shorter compilation is not mentioned: it does not explain why a step took longer than its solver."""


@dataclass(frozen=True, slots=True)
class Method:
    """A solver of the demo: its name, its label, the file of its video, and its time limit."""

    solver: Literal["admm", "twist"]
    label: str
    file: str
    budget_s: float | None


def analyse(plan: DemoPlan, captured: Captured, rig: RigConfig, journal: StepJournal) -> DemoResult:
    """Return everything that the report shows; write the truth and the videos to ``plan.out``."""
    recording = open_recording(captured.path)
    with journal.stage("Cut both arms") as note:
        first = recording.first_line + segment_row(rig)
        note["detail"] = f"lines {first} to {first + SEGMENT_LINES - 1}"
        segment = recording.cut(first, SEGMENT_LINES)
    # the scene as the recording describes it, not as this process remembers it
    scene = build_scene(
        LedSceneConfig.model_validate(recording.attrs["scene"]),
        segment.geometry.size,
        segment.substep_ns * 1e-9,
    )
    assert isinstance(scene, LedScene)
    with journal.stage("Save the truth at full resolution"):
        _save_truth(plan.out / "truth.zarr", scene, segment)
    # In this order: the report's headline quotes the first (`DemoResult`).
    methods = (
        Method("admm", "ADMM (default)", "video.zarr", plan.budget_s),
        Method("twist", "TwIST (the paper's)", "video-twist.zarr", plan.twist_budget_s),
    )
    host = HostWatch()
    # Between the solvers, so that their own load is not taken for the host's.
    host.look()
    videos = []
    for method in methods:
        videos.append(_solve(method, segment, journal))
        host.look()
    for method, video in zip(methods, videos, strict=True):
        save_reconstruction(plan.out / method.file, video, recording, segment, N_M)
    trusted = videos[0].trusted
    with journal.stage("Compare with the truth"):
        voxels = truth(scene, _first_substep(segment), segment.geometry.span, N_M, T_M)[trusted]
        regions = _regions(scene, segment, trusted)
        solvers = tuple(
            evaluate_solver(
                method.label,
                video.video[trusted],
                voxels,
                regions,
                segment.substep_ns * T_M * 1e-9,
                seconds=video.seconds,
                iterations=video.iterations,
                requested_iterations=video.iterations_asked,
                budget_s=method.budget_s,
            )
            for method, video in zip(methods, videos, strict=True)
        )
    return DemoResult(
        title=str(recording.attrs["scene"]["title"]),
        when=journal.when,
        command=plan.command,
        seed=plan.seed,
        rig=_rig_facts(recording),
        capture=_capture_facts(recording, captured),
        segment=segment,
        start_ns=int(np.asarray(recording.camera("a").time_ns[:1])[0]),
        frame_time_ns=videos[0].time_ns[trusted],
        truth=voxels,
        solvers=solvers,
        regions=regions,
        stages=tuple(journal.stages),
        host=host.busyness(),
    )


def _solve(method: Method, segment: Segment, journal: StepJournal) -> Reconstruction:
    name = f"Reconstruct: {method.label}"
    with journal.stage(name) as note, stage_progress(name) as advance:
        result = reconstruct(
            segment,
            N_M,
            T_M,
            budget_s=method.budget_s,
            progress=lambda step: advance(step.iteration, step.iterations),
            solver=method.solver,
            refuse=False,  # the report shows a poor result rather than none
        )
        note["detail"] = counted(result.iterations, "iteration")
        if result.compiled_s >= REPORTED_S:
            note["detail"] += f", including {result.compiled_s:.1f} s of compilation, needed {how_often()}"
    return result


def _first_substep(segment: Segment) -> int:
    return segment.geometry.substeps * segment.first_line


def _save_truth(path: Path, scene: LedScene, segment: Segment) -> None:
    """Write the scene during the segment: every sub-step at full resolution."""
    frames = scene.frames(_first_substep(segment), segment.geometry.span)
    provenance = {"first_substep": _first_substep(segment), "first_line": segment.first_line}
    write_video(
        path,
        frames,
        segment.frame_time_ns(),
        pixel_size=1.0,
        frame_interval_ns=segment.substep_ns,
        provenance=provenance,
        pixel_unit=None,
    )


def _regions(scene: LedScene, segment: Segment, trusted: slice) -> tuple[Region, ...]:
    """Return one region per LED that fills a voxel, with its theoretical light in the voxels it covers."""
    first = _first_substep(segment) + trusted.start
    light = scene.intensity(first, trusted.stop - trusted.start)
    side = scene.size // N_M
    covered = scene.masks.reshape(-1, side, N_M, side, N_M).mean(axis=(2, 4))
    regions = []
    for led, mask, curve in zip(scene.leds, covered, light, strict=True):
        inner = mask >= INNER
        if not inner.any():
            continue
        set_hz = led.drive.frequency_hz if isinstance(led.drive, SineDrive) else None
        # A voxel that a shape covers in part has that part of its light.
        regions.append(Region(led.name, inner, curve * float(mask[inner].mean()), set_hz))
    return tuple(regions)


def _rig_facts(recording: Recording) -> RigFacts:
    attrs: dict[str, Any] = recording.attrs
    code = attrs["code"]
    # The start is 0 in every recording.
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
        arms={
            name: ArmAccount(
                delivered=arm.delivered,
                preroll=arm.preroll,
                discarded=arm.discarded,
                recorded=arm.recorded,
                missing=arm.missing,
                ring_peak=arm.ring.peak,
                ring_slots=arm.ring.slots,
                lost=arm.lost,
            )
            for name, arm in captured.status.arms.items()
        },
    )
