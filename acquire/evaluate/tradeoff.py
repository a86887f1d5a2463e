"""Accuracy against time for solvers, presets and voxel sizes, from the intermediate results of each run.

A callback observes the result that a run would have if it ended at that moment, with the wall and processor
time so far, including set-up but not the time of observation. It is compared with the truth if that is known
(in simulated recordings), and otherwise judged by its prediction of held-out samples.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.config import load_recorded
from acquire.config.scene import SineDrive
from acquire.errors import UsageError
from acquire.evaluate.curves import compare_curve, region_mean
from acquire.evaluate.metrics import psnr, ssim
from acquire.forward import merge_video
from acquire.recon import reconstruct
from acquire.sim.leds import LedScene
from acquire.sim.optics import tile_view
from acquire.sim.scene import Scene
from acquire.sim.voxels import truth
from acquire.simulate import bench_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from acquire.arrays import Dtype
    from acquire.fibre import Tile
    from acquire.lines import Segment
    from acquire.recon import Look, Preset
    from acquire.recon.segments import Voxels
    from acquire.store import Recording

APART = 1.15
"""Ratio of the times of two observed results."""
CUT = ("budget", "stopped")
DIMMER = 0.5
"""Weight of missing light relative to additional light, in the choice of the frame to show."""
SSIM_WINDOW, SSIM_FRAMES = 11, 64
"""Window of SSIM in voxels, and number of evenly spaced frames in its mean."""
COVERED = 0.9
"""Share of a voxel that an LED must cover to be evaluated for amplitude and frequency."""


@dataclass(frozen=True, slots=True)
class Point:
    """Accuracy and time of the result after ``iterations``; None for values that are unknown or do not apply.

    ``seconds`` is wall time, ``processor_s`` the time of all threads. ``amplitude_error`` is the relative
    error of the changes over time, ``frequency_error_hz`` the largest error among the scene's sinusoids.
    ``prediction`` is the held-out error of the last result. ``frame`` is one frame to show.
    """

    iterations: int
    seconds: float
    processor_s: float = 0.0
    stage: str = ""
    psnr_db: float | None = None
    ssim: float | None = None
    amplitude_error: float | None = None
    frequency_error_hz: float | None = None
    prediction: float | None = None
    frame: NDArray[np.float32] | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class TradeoffRun:
    """One reconstruction, from its first result to its last; ``ended`` is the reason for its end.

    ``case`` names the scene and its noise; ``repeat`` counts runs with the same settings. ``mean_db`` is the
    PSNR of the truth's mean over time, which is that of the best possible still.
    """

    solver: str
    voxels: Voxels
    dtype: str
    voxel_count: int
    points: tuple[Point, ...]
    preset: str = "balanced"
    case: str = ""
    repeat: int = 0
    ended: str = "done"
    mean_db: float | None = None

    @property
    def end(self) -> Point:
        return self.points[-1]

    @property
    def cut(self) -> bool:
        """Whether the run was cut short, so that it does not show what the solver can reach."""
        return self.ended in CUT


@dataclass(slots=True)
class TruthJudge:
    """Compares videos of a segment with the truth, if it is known: a scene, or ``light`` (T, n, n)."""

    segment: Segment
    scene: Scene | None
    light: NDArray[np.float32] | None = None
    _truths: dict[Voxels, NDArray[np.float32]] = field(default_factory=dict)

    @classmethod
    def of(cls, recording: Recording, segment: Segment, tile: Tile | None = None) -> TruthJudge:
        """Use the scene that a simulated recording describes; behind a fibre, that of a tile."""
        attrs = recording.attrs
        if not attrs.get("simulated") or "scene" not in attrs:
            return cls(segment, None)
        scene = bench_of(*load_recorded(attrs, str(recording))).summed_scene()
        if tile is not None and recording.fibre is not None:
            scene = tile_view(scene, recording.fibre, tile)
        return cls(segment, scene)

    def frames(self, voxels: Voxels) -> slice:
        """Return the frames to judge: the trusted ones, or all if there are none."""
        trusted = self.segment.geometry.trusted_frames(voxels.temporal_merge)
        return trusted if trusted.stop > trusted.start else slice(None)

    def truth(self, voxels: Voxels) -> NDArray[np.float32] | None:
        """Return the true voxels of `frames`; None if the truth is not known."""
        if self.scene is None and self.light is None:
            return None
        # Kept: every solver, preset and dtype is compared with the same truth.
        if voxels not in self._truths:
            geometry, merges = self.segment.geometry, (voxels.spatial_merge, voxels.temporal_merge)
            if self.light is not None:
                whole = np.asarray(merge_video(self.light, *merges), np.float32)
            else:
                assert self.scene is not None
                whole = truth(self.scene, geometry.substeps * self.segment.first_line, geometry.span, *merges)
            self._truths[voxels] = whole[self.frames(voxels)]
        return self._truths[voxels]

    def check(self, voxels: Voxels) -> None:
        """Raise UsageError if the truth is dark, which no accuracy can be relative to."""
        true = self.truth(voxels)
        if true is not None and not true.max() > 0:
            first, lines = self.segment.first_line, self.segment.geometry.lines
            raise UsageError(
                f"the scene is dark in the frames of lines {first} to {first + lines - 1}, which leaves no "
                "accuracy to measure",
                possible="--first-line and --lines of a range with light",
            )

    def judged(self, point: Point, video: NDArray[Any], voxels: Voxels) -> Point:
        """Return ``point`` with the accuracy of its video."""
        shown, true = video[self.frames(voxels)], self.truth(voxels)
        # a copy, because a view would keep the whole video of every point
        point = replace(point, frame=np.array(shown[self.picked(voxels)], np.float32))
        if true is None:
            return point
        some, peak = slice(None, None, max(1, len(true) // SSIM_FRAMES)), float(true.max())
        return replace(
            point,
            psnr_db=psnr(shown, true),
            ssim=None if min(true.shape[1:]) < SSIM_WINDOW else ssim(shown[some], true[some], peak),
            amplitude_error=amplitude_error(shown, true),
            frequency_error_hz=self._frequency_error(shown, voxels),
        )

    def mean_db(self, voxels: Voxels) -> float | None:
        """Return the PSNR of the truth's mean over time; None if the truth is unknown or constant."""
        true = self.truth(voxels)
        if true is None or np.array_equal(true, true[:1].repeat(len(true), axis=0)):
            return None
        return psnr(np.broadcast_to(true.mean(axis=0), true.shape), true)

    def picked(self, voxels: Voxels) -> int:
        """Return the frame to show: where the truth differs most from its mean, preferably by more light.

        Without a truth it is the middle frame.
        """
        true = self.truth(voxels)
        if true is None:
            frames = self.segment.geometry.video_shape(1, voxels.temporal_merge)[0]
            return len(range(*self.frames(voxels).indices(frames))) // 2
        first = len(true) // 4
        # in the middle half
        away = true[first : max(3 * first, first + 1)] - true.mean(axis=0)
        return first + int(np.argmax(np.square(np.where(away > 0, away, DIMMER * away)).sum(axis=(1, 2))))

    def _frequency_error(self, shown: NDArray[Any], voxels: Voxels) -> float | None:
        if not isinstance(self.scene, LedScene) or self.scene.size % voxels.spatial_merge:
            return None
        side, merge = self.scene.size // voxels.spatial_merge, voxels.spatial_merge
        masks = self.scene.masks.reshape(-1, side, merge, side, merge).mean(axis=(2, 4)) >= COVERED
        interval_s = self.segment.substep_ns * voxels.temporal_merge * 1e-9
        errors = []
        for led, mask in zip(self.scene.leds, masks, strict=True):
            # below the Nyquist frequency of the frames
            visible = isinstance(led.drive, SineDrive) and 2 * led.drive.frequency_hz * interval_s < 1
            # 16 frames are twice the unknowns of a sinusoid with its three harmonics.
            if not visible or not mask.any() or len(shown) < 16:
                continue
            true = self.truth(voxels)
            assert true is not None
            curve = compare_curve(led.name, region_mean(true, mask), region_mean(shown, mask), interval_s)
            errors.append(abs(curve.frequency_error_hz or 0.0))
        return max(errors) if errors else None


def amplitude_error(video: NDArray[Any], truth: NDArray[Any]) -> float | None:
    """Return |slope − 1| of the video's changes over time against the truth's; None if nothing changes."""
    true = truth - truth.mean(axis=0)
    swing = float(np.vdot(true, true))
    if swing < 1e-6 * float(np.vdot(truth, truth)):
        return None
    # the regression's slope, which noise of the video does not bias
    return abs(float(np.vdot(true, video - video.mean(axis=0))) / swing - 1)


def measure(
    judge: TruthJudge,
    solver: str,
    voxels: Voxels,
    *,
    preset: Preset = "balanced",
    longest_s: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    dtype: Dtype = "float32",
) -> TradeoffRun:
    """Reconstruct once and observe intermediate results, with the time so far but without that of observing.

    The run is cut after ``longest_s``. Raises UsageError for a dark scene.
    """
    # first, because a reconstruction may take minutes
    judge.check(voxels)
    points: list[Point] = []

    def look(now: Look) -> None:
        # By their ratio: the curves are drawn over the logarithm of time.
        if points and now.seconds < APART * points[-1].seconds:
            return
        begun = time.monotonic(), time.process_time()
        video = now.video()
        made_s = time.monotonic() - begun[0], time.process_time() - begun[1]  # a result needs its video
        at = Point(now.iteration, now.seconds + made_s[0], now.processor_s + made_s[1], now.stage)
        points.append(judge.judged(at, video, voxels))

    result = reconstruct(
        judge.segment,
        voxels.spatial_merge,
        voxels.temporal_merge,
        preset,
        budget_s=longest_s,
        progress=None if progress is None else lambda step: progress(step.iteration, step.iterations),
        solver=solver,
        dtype=dtype,
        # What a solver cannot do well is a result of a trade-off, too.
        refuse=False,
        look=look,
        # What explains the lines better, and how large the error is, take no part of the solver's time: the
        # points before the end come without them.
        check=False,
        error=False,
    )
    # None, since the page's JSON cannot hold NaN.
    prediction = None if np.isnan(result.quality.prediction) else result.quality.prediction
    last = Point(result.iterations, result.seconds, result.processor_s, "end", prediction=prediction)
    # an observed result counts the making of its video, and may be later than the end
    earlier = (each for each in points if each.seconds < last.seconds)
    return TradeoffRun(
        solver=solver,
        voxels=voxels,
        dtype=dtype,
        voxel_count=int(result.video.size),
        points=(*earlier, judge.judged(last, result.video, voxels)),
        preset=preset,
        ended=result.ended,
        mean_db=judge.mean_db(voxels),
    )


def pareto(runs: Iterable[TradeoffRun]) -> list[tuple[TradeoffRun, Point]]:
    """Return the points whose accuracy no other run reaches sooner, in order of time; for equal voxels."""
    everything = sorted(
        ((run, point) for run in runs for point in run.points if point.psnr_db is not None),
        key=lambda each: each[1].seconds,
    )
    front: list[tuple[TradeoffRun, Point]] = []
    for run, point in everything:
        if not front or (point.psnr_db or 0) > (front[-1][1].psnr_db or 0):
            front.append((run, point))
    return front


def table(runs: Sequence[TradeoffRun]) -> list[dict[str, Any]]:
    """Return every observed result as a flat row."""
    kinds = dict.fromkeys((run.case, run.voxels) for run in runs)
    fronts = {
        # by identity, because points of two runs may be equal
        id(point)
        for kind in kinds
        for _, point in pareto(run for run in runs if (run.case, run.voxels) == kind)
    }
    return [
        {
            "case": run.case,
            "spatial_merge": run.voxels.spatial_merge,
            "temporal_merge": run.voxels.temporal_merge,
            "solver": run.solver,
            "preset": run.preset,
            "dtype": run.dtype,
            "repeat": run.repeat,
            "voxels": run.voxel_count,
            "iterations": point.iterations,
            "stage": point.stage,
            "ended": run.ended if point is run.end else None,
            "seconds": round(point.seconds, 4),
            "processor_s": round(point.processor_s, 4),
            "psnr_db": point.psnr_db,
            "ssim": point.ssim,
            "amplitude_error": point.amplitude_error,
            "frequency_error_hz": point.frequency_error_hz,
            "prediction": point.prediction,
            "pareto": id(point) in fronts,
            "mean_db": run.mean_db,
        }
        for run in runs
        for point in run.points
    ]
