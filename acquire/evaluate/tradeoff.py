"""What accuracy costs in time: every solver, preset and kind of voxels, iteration by iteration.

A run is observed at iterations that are equally spaced in logarithm; the clock stands still while its video
is judged. Against the truth where it is known (simulated recordings), else by the samples it predicts.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.config import RigConfig
from acquire.evaluate.curves import compare_curve, region_mean
from acquire.evaluate.metrics import psnr, ssim
from acquire.recon import reconstruct
from acquire.scene_config import SceneFile, SineDrive
from acquire.sim.leds import LedScene
from acquire.sim.scene import Scene
from acquire.sim.voxels import truth
from acquire.simulate import bench_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon import Progress
    from acquire.recon.api import Preset, Solver
    from acquire.recon.segments import Voxels
    from acquire.store import Recording

OBSERVATIONS_PER_OCTAVE = 3
COVERED = 0.9
"""Voxels of an LED's mask that are followed for amplitude and frequency."""


@dataclass(frozen=True, slots=True)
class Point:
    """How good a video was after a time. ``None``: not known, or not a quantity of this scene.

    ``amplitude_error`` is that of the swings over time, relative; ``frequency_error_hz`` the largest among
    the scene's sinusoids.
    """

    iteration: int
    seconds: float
    psnr_db: float | None
    ssim: float | None
    amplitude_error: float | None
    frequency_error_hz: float | None


@dataclass(frozen=True, slots=True)
class Run:
    """One solver on one kind of voxels with a preset's parameters."""

    solver: Solver
    preset: Preset
    voxels: Voxels
    dtype: str
    voxel_count: int
    points: tuple[Point, ...]
    prediction: float | None

    @property
    def end(self) -> Point:
        return self.points[-1]


@dataclass(slots=True)
class Judge:
    """Compares videos of a segment with the truth, where there is one."""

    segment: Segment
    scene: Scene | None
    _truths: dict[Voxels, NDArray[np.float32]] = field(default_factory=dict)

    @classmethod
    def of(cls, recording: Recording, segment: Segment) -> Judge:
        """The scene is what a simulated recording says it was."""
        attrs = recording.attrs
        if not attrs.get("simulated") or "scene" not in attrs:
            return cls(segment, None)
        rig = RigConfig.model_validate(attrs["config"])
        return cls(segment, bench_of(rig, SceneFile.model_validate(attrs["scene"]).root).fine_scene())

    def frames(self, voxels: Voxels) -> slice:
        """What is judged: the trusted frames, or all where none is."""
        trusted = self.segment.geometry.trusted_frames(voxels.temporal_merge)
        return trusted if trusted.stop > trusted.start else slice(None)

    def truth(self, voxels: Voxels) -> NDArray[np.float32] | None:
        """The true voxels of `frames`."""
        if self.scene is None:
            return None
        if voxels not in self._truths:
            geometry = self.segment.geometry
            first = geometry.substeps * self.segment.first_line
            whole = truth(self.scene, first, geometry.span, voxels.spatial_merge, voxels.temporal_merge)
            self._truths[voxels] = whole[self.frames(voxels)]
        return self._truths[voxels]

    def point(self, iteration: int, seconds: float, voxels: Voxels, video: NDArray[Any]) -> Point:
        """How good a video (of the whole span) is."""
        true = self.truth(voxels)
        if true is None:
            return Point(iteration, seconds, None, None, None, None)
        shown = video[self.frames(voxels)]
        small = min(true.shape[1:]) < 11
        return Point(
            iteration,
            seconds,
            psnr(shown, true),
            None if small else ssim(shown, true),
            amplitude_error(shown, true),
            self._frequency_error(shown, voxels),
        )

    def _frequency_error(self, shown: NDArray[Any], voxels: Voxels) -> float | None:
        if not isinstance(self.scene, LedScene) or self.scene.size % voxels.spatial_merge:
            return None
        side, merge = self.scene.size // voxels.spatial_merge, voxels.spatial_merge
        masks = self.scene.masks.reshape(-1, side, merge, side, merge).mean(axis=(2, 4)) >= COVERED
        interval_s = self.segment.substep_ns * voxels.temporal_merge * 1e-9
        errors = []
        for led, mask in zip(self.scene.leds, masks, strict=True):
            visible = isinstance(led.drive, SineDrive) and 2 * led.drive.frequency_hz * interval_s < 1
            if not visible or not mask.any() or len(shown) < 16:
                continue
            true = self.truth(voxels)
            assert true is not None
            curve = compare_curve(led.name, region_mean(true, mask), region_mean(shown, mask), interval_s)
            errors.append(abs(curve.frequency_error_hz or 0.0))
        return max(errors) if errors else None


def amplitude_error(video: NDArray[Any], truth: NDArray[Any]) -> float | None:
    """|slope − 1| of the video's changes over time against the truth's; None where nothing changes."""
    true = truth - truth.mean(axis=0)
    swing = float(np.vdot(true, true))
    if swing < 1e-6 * float(np.vdot(truth, truth)):
        return None
    return abs(float(np.vdot(true, video - video.mean(axis=0))) / swing - 1)


def measure(
    judge: Judge,
    solver: Solver,
    preset: Preset,
    voxels: Voxels,
    budget_s: float | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Run:
    """Reconstruct once, looking at the video on the way."""
    points: list[Point] = []
    clock = _Stopwatch()
    iteration = 0

    def observe(video: Callable[[], NDArray[np.float32]]) -> None:
        nonlocal iteration
        iteration += 1
        with clock.stopped():
            if _is_looked_at(iteration):
                points.append(judge.point(iteration, clock.seconds(), voxels, video()))

    def advanced(step: Progress) -> None:
        if progress is not None:
            progress(step.iteration, step.iterations)

    judge.truth(voxels)
    clock.start()
    result = reconstruct(
        judge.segment,
        voxels.spatial_merge,
        voxels.temporal_merge,
        preset,
        None,
        advanced,
        solver=solver,
        observe=observe,
        stop=lambda: budget_s is not None and clock.seconds() > budget_s,
    )
    seconds = clock.seconds()
    if not points or points[-1].iteration != result.iterations:
        points.append(judge.point(result.iterations, seconds, voxels, result.video))
    prediction = None if np.isnan(result.quality.prediction) else result.quality.prediction
    dtype, count = str(result.video.dtype), int(result.video.size)
    return Run(solver, preset, voxels, dtype, count, tuple(points), prediction)


def pareto(runs: Iterable[Run]) -> list[tuple[Run, Point]]:
    """Points that no other reaches sooner, by time; of runs in the same voxels."""
    everything = sorted(
        ((run, point) for run in runs for point in run.points if point.psnr_db is not None),
        key=lambda each: each[1].seconds,
    )
    front: list[tuple[Run, Point]] = []
    for run, point in everything:
        if not front or (point.psnr_db or 0) > (front[-1][1].psnr_db or 0):
            front.append((run, point))
    return front


def table(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Every observation as a flat row."""
    fronts = {
        (id(run), point.iteration)
        for voxels in {run.voxels for run in runs}
        for run, point in pareto(run for run in runs if run.voxels == voxels)
    }
    return [
        {
            "spatial_merge": run.voxels.spatial_merge,
            "temporal_merge": run.voxels.temporal_merge,
            "solver": run.solver,
            "preset": run.preset,
            "dtype": run.dtype,
            "voxels": run.voxel_count,
            "iteration": point.iteration,
            "seconds": round(point.seconds, 4),
            "psnr_db": point.psnr_db,
            "ssim": point.ssim,
            "amplitude_error": point.amplitude_error,
            "frequency_error_hz": point.frequency_error_hz,
            "end_of_preset": point is run.end,
            "pareto": (id(run), point.iteration) in fronts,
        }
        for run in runs
        for point in run.points
    ]


def _is_looked_at(iteration: int) -> bool:
    """Equally spaced in logarithm."""
    octaves = np.log2([iteration, max(1, iteration - 1)]) * OBSERVATIONS_PER_OCTAVE
    return iteration == 1 or int(octaves[0]) > int(octaves[1])


class _Stopwatch:
    """Seconds since `start` less those for which it was stopped."""

    def __init__(self) -> None:
        self._began = self._paused = time.perf_counter()
        self._out = 0.0

    def start(self) -> None:
        self._began, self._out = time.perf_counter(), 0.0

    def seconds(self) -> float:
        return time.perf_counter() - self._began - self._out

    def stopped(self) -> _Stopwatch:
        return self

    def __enter__(self) -> None:
        self._paused = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._out += time.perf_counter() - self._paused
