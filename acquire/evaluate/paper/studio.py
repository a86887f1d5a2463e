"""The studio that all figures of the paper share: recordings of scenes, reconstructions and the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.config import load_plan, load_recorded, load_rig, load_scene
from acquire.config.scene import OpticsConfig
from acquire.evaluate.host import HostWatch
from acquire.evaluate.metrics import psnr, ssim
from acquire.evaluate.paper.comparison import Row
from acquire.recon import reconstruct
from acquire.recon.segments import Voxels
from acquire.reconstruct import Monitor, Options, along_plan, combine, in_voxels, open_pool
from acquire.reconstruct.select import Selection, by_lines
from acquire.sim.effects.charge import ReadNoise, ShotNoise
from acquire.sim.voxels import truth
from acquire.simulate import bench_of, simulate
from acquire.store import open_recording, open_video

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon import Reconstruction
    from acquire.reconstruct import Outcome, VideoRequest
    from acquire.sim.scene import Scene
    from acquire.store import Recording

FULL_WELL_E, READ_NOISE_E = 1e4, 10.0
"""An ordinary camera: electrons in the brightest sample, and read noise in electrons."""
TRUE_PEAK = 1.0
"""Brightest value of the scenes."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A drawing with its caption. Narrow pages show ``narrow``, or the same figure ``narrow_in`` high."""

    name: str
    drawing: Figure
    caption: str
    narrow: Figure | None = None
    narrow_in: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PaperFigure:
    """Our version of a figure of the paper.

    ``movie`` maps the labels of the videos shown side by side to their frames (t, row, column); ``movie_ms``
    is the interval between two frames.
    """

    name: str
    title: str
    text: str
    pictures: tuple[Picture, ...]
    rows: tuple[Row, ...]
    seconds: dict[str, float]
    numbers: dict[str, float] = field(default_factory=dict)
    movie: dict[str, NDArray[Any]] = field(default_factory=dict)
    movie_ms: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """The trusted frames of a scene with T_m = 1, and the truth.

    ``video`` and ``truth`` are (time, row, column); ``first_substep`` is that of their first frame.
    """

    scene: Scene
    segment: Segment
    video: NDArray[Any]
    truth: NDArray[Any]
    first_substep: int
    seconds: float

    @property
    def times_ms(self) -> NDArray[np.floating[Any]]:
        """Start of each frame, after the read-out of line 0."""
        geometry = self.segment.geometry
        first = self.first_substep - geometry.readout_substep
        return (first + np.arange(len(self.video))) * (self.segment.substep_ns * 1e-6)

    def numbers(self) -> dict[str, float]:
        """Return PSNR in dB and SSIM against the truth."""
        return {"psnr_db": psnr(self.video, self.truth), "ssim": ssim(self.video, self.truth)}

    def accuracy(self) -> Row:
        psnr_db, likeness = self.numbers().values()
        return Row("accuracy", "–", f"{psnr_db:.1f} dB, SSIM {likeness:.3f} in {self.seconds:.1f} s")


@dataclass(slots=True)
class Studio:
    """Makes and reconstructs recordings in ``directory``; ``say`` is called with the current activity."""

    directory: Path
    options: Options = field(default_factory=Options)
    seed: int = 1
    say: Callable[[str], object] = lambda _: None
    seconds: dict[str, float] = field(default_factory=dict)
    host: HostWatch = field(default_factory=HostWatch)

    def record(
        self, scene_name: str, lines: int, *, interline: bool = False, gain_dn_per_e: float | None = None
    ) -> Recording:
        """Return a recording of a built-in scene with its rig and this studio's exposure code; made once.

        With ``interline`` the charge moves by whole pixels, as in the baseline of Fig. 6; with
        ``gain_dn_per_e`` the camera has shot noise and the read noise `READ_NOISE_E`.
        """
        # figures share recordings: a name stands for everything that they differ in
        name = f"{scene_name}-interline" if interline else scene_name
        name += "" if gain_dn_per_e is None else "-noisy"
        if (self.directory / f"{name}.zarr").exists():
            return open_recording(self.directory / f"{name}.zarr")
        self.say(f"recording {name}")
        scene = load_scene(scene_name)
        if interline:
            optics = OpticsConfig(layout="interline")
            scene = scene.model_copy(update={"optics": optics, "rig": "rig-interline"})
        if gain_dn_per_e is not None:
            noise = (ShotNoise(kind="shot_noise"), ReadNoise(kind="read_noise", sigma_e=READ_NOISE_E))
            scene = scene.model_copy(update={"effects": noise, "system_gain_dn_per_e": gain_dn_per_e})
        # The seed of the studio, so that `acquire paper --seed` repeats all figures with another code.
        rig = load_rig(scene.rig, {"code.seed": self.seed})
        path = self.directory / f"{name}.zarr"
        simulate(rig, scene, path, lines)
        return open_recording(path)

    def gain(self, segment: Segment) -> float:
        """Return the DN per electron of a camera whose full well is the brightest sample of ``segment``."""
        return float((segment.lines.max() - np.min(segment.black_level_dn)) / FULL_WELL_E)

    def solve(self, segment: Segment, spatial_merge: int, temporal_merge: int, what: str) -> Reconstruction:
        """Reconstruct a segment with the studio's options; its time is noted under ``what``."""
        self._begin(what)
        options = self.options
        result = reconstruct(
            segment,
            spatial_merge,
            temporal_merge,
            options.preset,
            budget_s=options.budget_s,
            solver=options.solver,
            iterations=options.iterations,
            # a figure shows a poor result rather than none
            refuse=False,
        )
        self._end(what, result.seconds)
        return result

    def shoot(self, scene_name: str, first_line: int, lines: int, what: str) -> Shot:
        """Record a scene and reconstruct the given lines with N_m = 3, T_m = 1."""
        recording = self.record(scene_name, first_line + lines)
        segment = recording.cut(first_line, lines)
        result = self.solve(segment, 3, 1, what)
        geometry = segment.geometry
        first = geometry.substeps * first_line
        truth = true_voxels(recording, first, geometry.span, 3, 1)[geometry.trusted]
        return Shot(
            scene=scene_of(recording),
            segment=segment,
            video=result.video[geometry.trusted],
            truth=truth,
            first_substep=first + geometry.trusted.start,
            seconds=result.seconds,
        )

    def stitch(self, recording: Recording, plan_name: str, first_line: int, what: str) -> Outcome:
        """Reconstruct along a built-in plan from a line on, with the sub-segments in parallel."""
        request = along_plan(by_lines(recording, first_line), load_plan(plan_name))
        return self._combine(recording, request, f"{plan_name}.zarr", what)

    def stitch_evenly(
        self, recording: Recording, selection: Selection, voxels: Voxels, pieces: int, what: str
    ) -> Outcome:
        """Reconstruct a selection in ``pieces`` equal sub-segments."""
        begin, end = selection.extent(voxels, voxels, whole=False)
        # Rounded up: pieces that are a sub-step shorter would leave one more.
        request = in_voxels(selection, voxels, longest=-(-(end - begin) // pieces))
        return self._combine(recording, request, f"{what.split(maxsplit=1)[0]}-video.zarr", what)

    def _combine(self, recording: Recording, request: VideoRequest, name: str, what: str) -> Outcome:
        self._begin(what)
        began = time.perf_counter()
        monitor = Monitor(len(request.stretches))
        with open_pool(len(request.stretches), watch=monitor) as pool:
            outcome = combine(
                recording,
                request,
                self.directory / name,
                options=self.options,
                pool=pool,
                monitor=monitor,
            )
        self._end(what, time.perf_counter() - began)
        return outcome

    def _begin(self, what: str) -> None:
        # Before and after, but not during the work: a look takes a core for hundredths of a second.
        self.host.look()
        self.say(f"reconstructing {what}")

    def _end(self, what: str, seconds: float) -> None:
        self.seconds[what] = seconds
        self.host.look()


def scene_of(recording: Recording) -> Scene:
    """Return the scene that the recording describes, at the resolution of its cameras."""
    return bench_of(*load_recorded(recording.attrs, str(recording))).fine_scene()


def true_voxels(
    recording: Recording, first_substep: int, count: int, spatial_merge: int, temporal_merge: int
) -> NDArray[np.float32]:
    """Return the true scene during ``count`` sub-steps of a recording, in voxels."""
    return truth(scene_of(recording), first_substep, count, spatial_merge, temporal_merge)


def read(outcome: Outcome) -> NDArray[np.float32]:
    """Read a whole video that was written."""
    return np.asarray(open_video(outcome.path).video[:], np.float32)
