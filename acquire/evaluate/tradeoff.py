"""What accuracy costs in time: every solver, preset and kind of voxels, iteration by iteration.

A solver is asked for more and more iterations; every answer is a whole one, with set-up and finish in its
time. Against the truth where it is known (simulated recordings), else by the samples it predicts.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.config import RigConfig
from acquire.evaluate.curves import compare_curve, region_mean
from acquire.evaluate.metrics import psnr, ssim
from acquire.recon import reconstruct
from acquire.recon.request import preset_iterations
from acquire.scene_config import SceneFile, SineDrive
from acquire.sim.leds import LedScene
from acquire.sim.scene import Scene
from acquire.sim.voxels import truth
from acquire.simulate import bench_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from acquire.arrays import Dtype
    from acquire.lines import Segment
    from acquire.recon import Preset, Reconstruction, Solver
    from acquire.recon.segments import Voxels
    from acquire.store import Recording

FEWEST_ITERATIONS = 4
SSIM_WINDOW = 11
COVERED = 0.9
"""Voxels of an LED's mask that are followed for amplitude and frequency."""


@dataclass(frozen=True, slots=True)
class Point:
    """How good the answer after ``iterations`` was. ``None``: not known, or not a quantity of this scene.

    ``amplitude_error`` is that of the swings over time, relative; ``frequency_error_hz`` the largest among
    the scene's sinusoids; ``prediction`` the error at samples that the solver did not see. ``presets`` are
    those that end here.
    """

    iterations: int
    seconds: float
    psnr_db: float | None = None
    ssim: float | None = None
    amplitude_error: float | None = None
    frequency_error_hz: float | None = None
    prediction: float | None = None
    presets: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Run:
    """One solver in one dtype on one kind of voxels, asked for more and more iterations."""

    solver: Solver
    voxels: Voxels
    dtype: str
    voxel_count: int
    points: tuple[Point, ...]

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

    def point(self, result: Reconstruction, voxels: Voxels) -> Point:
        """How good a reconstruction is."""
        prediction = None if np.isnan(result.quality.prediction) else result.quality.prediction
        found = Point(result.iterations, result.seconds, prediction=prediction)
        true = self.truth(voxels)
        if true is None:
            return found
        shown = result.video[self.frames(voxels)]
        return replace(
            found,
            psnr_db=psnr(shown, true),
            ssim=None if min(true.shape[1:]) < SSIM_WINDOW else ssim(shown, true),
            amplitude_error=amplitude_error(shown, true),
            frequency_error_hz=self._frequency_error(shown, voxels),
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
    voxels: Voxels,
    presets: Sequence[Preset] = ("fast", "balanced"),
    longest_s: float | None = None,
    progress: Callable[[int, int], object] | None = None,
    *,
    dtype: Dtype = "float32",
) -> Run:
    """Reconstruct with more and more iterations, up to the presets'; each answer is a whole one.

    The series ends early when a run takes ``longest_s``, or when more iterations change nothing.
    """
    limits = {preset: preset_iterations(solver, preset) for preset in presets}
    counts = _counts(limits.values())
    points: list[Point] = []
    result = None
    for number, count in enumerate(counts):
        result = reconstruct(
            judge.segment,
            voxels.spatial_merge,
            voxels.temporal_merge,
            budget_s=longest_s,
            solver=solver,
            iterations=count,
            dtype=dtype,
        )
        ended = result.ended != "done"
        reached = tuple(
            preset for preset, most in limits.items() if most == count or (ended and most > count)
        )
        points.append(replace(judge.point(result, voxels), presets=reached))
        if progress is not None:
            progress(number + 1, len(counts))
        if ended:
            break
    assert result is not None
    return Run(solver, voxels, dtype, int(result.video.size), tuple(points))


def _counts(limits: Iterable[int]) -> list[int]:
    """Iterations that are asked for: the presets', and halves of the largest down to a few."""
    wanted = set(limits)
    count = max(wanted)
    while count > FEWEST_ITERATIONS:
        wanted.add(count)
        count //= 2
    return sorted(wanted)


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
    """Every answer as a flat row."""
    fronts = {
        (id(run), point.iterations)
        for voxels in {run.voxels for run in runs}
        for run, point in pareto(run for run in runs if run.voxels == voxels)
    }
    return [
        {
            "spatial_merge": run.voxels.spatial_merge,
            "temporal_merge": run.voxels.temporal_merge,
            "solver": run.solver,
            "dtype": run.dtype,
            "voxels": run.voxel_count,
            "iterations": point.iterations,
            "preset": " ".join(point.presets),
            "seconds": round(point.seconds, 4),
            "psnr_db": point.psnr_db,
            "ssim": point.ssim,
            "amplitude_error": point.amplitude_error,
            "frequency_error_hz": point.frequency_error_hz,
            "prediction": point.prediction,
            "pareto": (id(run), point.iterations) in fronts,
        }
        for run in runs
        for point in run.points
    ]
