"""The demo's second half: cut, reconstruct by both solvers, compare with the truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from acquire.cli.demo.plan import N_M, SEGMENT_LINES, T_M, segment_row
from acquire.cli.progress import stage_progress
from acquire.config.scene import SineDrive
from acquire.cores import idle_cores, limit_blas
from acquire.evaluate.host import HostWatch
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
from acquire.sim.leds import LedScene, LedSceneConfig
from acquire.sim.scenes import build_scene
from acquire.sim.voxels import truth
from acquire.store import Recording, open_recording, write_video

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.cli.demo.capture import Captured
    from acquire.cli.demo.plan import DemoPlan
    from acquire.cli.journal import Journal
    from acquire.config import RigConfig
    from acquire.lines import Segment

INNER = 0.9
"""Regions hold the voxels that a shape covers at least so far: edges mix light and dark."""
SAID_S = 1.0
"""Compiling shorter than this explains nothing: the solver's own time is beside the stage's."""


@dataclass(frozen=True, slots=True)
class Method:
    """A solver of the demo: its name for people, its video's, and its time."""

    solver: Literal["admm", "twist"]
    label: str
    file: str
    budget_s: float | None


def analyse(plan: DemoPlan, captured: Captured, rig: RigConfig, journal: Journal) -> DemoResult:
    """Everything that the report shows; leaves truth and videos in ``plan.out``."""
    recording = open_recording(captured.path)
    with journal.stage("Cut both arms") as note:
        first = recording.first_line + segment_row(rig)
        note["detail"] = f"lines {first} to {first + SEGMENT_LINES - 1}"
        segment = recording.cut(first, SEGMENT_LINES)
    scene = _scene(recording, segment)
    with journal.stage("Save the truth at full resolution"):
        _save_truth(plan.out / "truth.zarr", scene, segment)
    methods = (
        Method("admm", "ADMM (default)", "video.zarr", plan.budget_s),
        Method("twist", "TwIST (the paper's)", "video-twist.zarr", plan.twist_budget_s),
    )
    host = HostWatch()
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
        interval_s = segment.substep_ns * T_M * 1e-9
        solvers = tuple(map(partial(_judge, voxels, regions, interval_s), methods, videos))
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


def _solve(method: Method, segment: Segment, journal: Journal) -> Reconstruction:
    name = f"Reconstruct: {method.label}"
    with journal.stage(name) as note, stage_progress(name) as advance, limit_blas(idle_cores()):
        result = reconstruct(
            segment,
            N_M,
            T_M,
            budget_s=method.budget_s,
            progress=lambda step: advance(step.iteration, step.iterations),
            solver=method.solver,
            refuse=False,  # the recording is made: something is shown of it
        )
        note["detail"] = f"{result.iterations} iterations"
        if result.compiled_s >= SAID_S:
            note["detail"] += f"; for {result.compiled_s:.1f} s of these compiled, once after an installation"
    return result


def _judge(
    voxels: NDArray[np.float32],
    regions: tuple[Region, ...],
    interval_s: float,
    method: Method,
    result: Reconstruction,
) -> SolverResult:
    return evaluate_solver(
        method.label,
        result.video[result.trusted],
        voxels,
        regions,
        interval_s,
        seconds=result.seconds,
        iterations=result.iterations,
        requested_iterations=result.iterations_asked,
        budget_s=method.budget_s,
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
    """One region per LED that fills a voxel; theory is its light in the voxels wholly behind its mask."""
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
        arms={
            name: ArmLedger(
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
