"""Fig. 11: Scene #3, the blade of a chopper sweeps over the target; 4000 frames from seven sub-segments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.evaluate.metrics import psnr, psnr_per_frame, ssim
from acquire.evaluate.paper.comparison import Row, faster, same, statement
from acquire.evaluate.paper.drawing import strip
from acquire.evaluate.paper.studio import PaperFigure, Picture, read, true_voxels
from acquire.evaluate.themed import HIGHLIGHT, SOLVER_COLOURS, THEORY, canvas
from acquire.recon.segments import Voxels
from acquire.reconstruct import by_time

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.paper.studio import Studio

BEGIN_MS, END_MS, PIECES = 30, 70, 7
# 70 ms are 2334 lines; the charge of the last frames passes through 64 more.
LINES = 2420
# 40 ms in sub-steps of 10 µs.
FRAMES = 4000
PAPER_S = 600.0
"""Least time that the paper needs for a segment."""
AROUND = 40
"""Number of frames on either side of a seam in which a jump would show."""


def figure(studio: Studio) -> PaperFigure:
    """Reconstruct 30 ms to 70 ms after the start."""
    recording = studio.record("scene-chopper", LINES)
    selection = by_time(recording, BEGIN_MS * 1_000_000, END_MS * 1_000_000)
    outcome = studio.stitch_evenly(recording, selection, Voxels(3, 1), PIECES, "chopper in 7 sub-segments")
    video = read(outcome)
    first = int(outcome.provenance["first_substep"])
    truth = true_voxels(recording, first, len(video), 3, 1)
    seams = [part["begin_substep"] - first for part in outcome.provenance["segments"][1:]]
    times = BEGIN_MS + np.arange(len(video)) * 0.01
    steps, true_steps = (np.sqrt(np.mean(np.diff(each, axis=0) ** 2, axis=(1, 2))) for each in (video, truth))
    # the sweep itself changes the picture from frame to frame
    excess = steps - true_steps
    jump = max(float(excess[seam - AROUND : seam + AROUND].max()) for seam in seams)
    usual = float(np.quantile(excess, 0.99))
    error = psnr_per_frame(video, truth)
    numbers = {"psnr_db": psnr(video, truth), "ssim": ssim(video, truth), "seam_jump_ratio": jump / usual}
    picks = np.linspace(100, len(video) - 200, 7).astype(int)
    seconds = studio.seconds["chopper in 7 sub-segments"]
    return PaperFigure(
        name="fig11",
        title="Scene #3: a chopper over the target",
        text="A blade sweeps over a stationary target. 4000 frames of 64 × 64 voxels, 10 µs apart, from "
        "seven sub-segments that overlap as in Fig. 5, reconstructed in parallel and stitched.",
        pictures=(
            strip(
                "frames",
                "(b) the blade during the sweep.",
                (("ours", video[picks]), ("truth", truth[picks])),
                [f"{times[p]:.2f} ms" for p in picks],
            ),
            Picture(
                "seams",
                _seams(times, steps, true_steps, error, seams),
                "Change from frame to frame, and PSNR of each frame. Yellow: the seams.",
            ),
        ),
        rows=(
            same(
                "video",
                "64 × 64 × 4000 from 7 sub-segments",
                f"64 × 64 × {len(video)} from {len(seams) + 1}",
                equal=(len(video), len(seams) + 1) == (FRAMES, PIECES),
            ),
            Row("the sweep", "clearly presented", f"{numbers['psnr_db']:.1f} dB, SSIM {numbers['ssim']:.3f}"),
            statement(
                "seams",
                "combined together",
                f"largest jump at a seam: {jump / usual:.2f} of the 99th percentile of all frames",
                "no larger than elsewhere" if jump <= usual else "larger than elsewhere",
                hold=jump <= usual,
            ),
            faster(
                "time",
                "“ten more minutes” for one segment",
                f"{seconds:.0f} s for all {PIECES}",
                seconds=seconds / PIECES,
                paper_s=PAPER_S,
                where="per segment; the paper's machine is an i7-10750H",
            ),
        ),
        seconds=dict(studio.seconds),
        numbers=numbers,
        # every 32nd frame of 10 µs
        # Every frame would be 4000 pictures, far more than a page can hold (`player.MAX_BYTES`).
        movie={"ours": video[::32], "truth": truth[::32]},
        movie_ms=0.32,
    )


def _seams(
    times: NDArray[Any], steps: NDArray[Any], true_steps: NDArray[Any], error: NDArray[Any], seams: list[int]
) -> Figure:
    drawing = canvas(4.0)
    upper, lower = drawing.subplots(2, 1, sharex=True)
    upper.plot(times[1:], true_steps, color=THEORY, lw=2, label="truth")
    upper.plot(times[1:], steps, color=SOLVER_COLOURS[0], lw=0.8, label="ours")
    upper.set(ylabel="change to next frame", xlim=(times[0], times[-1]), ylim=(0, None))
    drawing.legend(ncols=2, loc="outside upper right")
    lower.plot(times, error, color=SOLVER_COLOURS[0], lw=0.8)
    lower.set(ylabel="PSNR (dB)", xlabel="time (ms)")
    for ax in (upper, lower):
        for seam in seams:
            ax.axvline(times[seam], color=HIGHLIGHT, lw=1.2, zorder=0)
    return drawing
