"""Fig. 8: combinatorial reconstruction of three sub-segments with different voxels, stitched together."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.evaluate.metrics import psnr
from acquire.evaluate.paper.bars import contrasts, last_resolved, place_of
from acquire.evaluate.paper.comparison import Row, in_elements, same, statement
from acquire.evaluate.paper.drawing import box, compared, show
from acquire.evaluate.paper.studio import PaperFigure, Picture, read, true_voxels
from acquire.evaluate.themed import canvas

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.paper.studio import Studio

LINES = 2140
# The shortest T_m of plan-window, that of #A and #C, sets the frames of the whole video.
T_OUT = 4
KEPT = "2136 + 1972 + 2136"
NARROW_CLOSE_IN = 1.5
FIELD_MM, GROUPS = 6.4, (2, 3)
CLOSE = (slice(20, 104), slice(18, 66))
"""Rows and columns of the close-up: group 2, elements 2 to 6."""


def figure(studio: Studio) -> PaperFigure:
    """Reconstruct a window that slides up over the target, opens, and slides to the left."""
    recording = studio.record("scene-window", LINES)
    outcome = studio.stitch(recording, "plan-window", 0, "three sub-segments")
    video = read(outcome)
    # 2136 + 1972 + 2136
    substeps = 6244
    coarse = true_voxels(recording, 0, substeps, 3, T_OUT)
    fine = true_voxels(recording, 0, substeps, 1, T_OUT)
    edges = [part["begin_substep"] // T_OUT for part in outcome.provenance["segments"]] + [len(video)]
    a, b, c = (slice(low, high) for low, high in pairwise(edges))
    numbers = {
        # #A and #C have voxels of 3 × 3 fine pixels, which the video repeats: one of each is compared.
        "a_psnr_db": psnr(video[a, ::3, ::3], coarse[a], 1.0),
        "b_psnr_db": psnr(video[b], fine[b], 1.0),
        "c_psnr_db": psnr(video[c, ::3, ::3], coarse[c], 1.0),
    }
    # The window is open in #B: all its frames show the same.
    still = video[b].mean(axis=0)
    resolved = last_resolved(contrasts(still, FIELD_MM, GROUPS))
    # the truth in voxels of N_m = 3, which #A and #C cannot surpass
    open_coarse = last_resolved(
        contrasts(fine[b][0].reshape(54, 3, 54, 3).mean(axis=(1, 3)), FIELD_MM, GROUPS)
    )
    # 1.8 million sub-steps per second
    frame_ms = T_OUT / 1.8e3
    picks_a = np.linspace(a.start + 110, a.stop - 130, 5).astype(int)
    picks_b = np.linspace(b.start + 20, b.stop - 20, 5).astype(int)
    picks_c = np.linspace(c.start + 130, c.stop - 110, 5).astype(int)
    return PaperFigure(
        name="fig8",
        title="Combinatorial reconstruction: a sliding window",
        text="Three sub-segments of 2136, 1972 and 2136 sub-steps. #A and #C are reconstructed in voxels of "
        "N_m = 3, T_m = 4. #B, which is stationary, is reconstructed in voxels of N_m = 1, T_m = 220 (230, "
        "adjusted so that nine fill it), from the lines that see only #B. One video holds all three.",
        pictures=(
            compared(
                "a", "(a), (b) #A: the window slides up.", video, truth=fine, picks=picks_a, frame_ms=frame_ms
            ),
            compared(
                "b",
                "(d) #B: the open window, in fine pixels.",
                video,
                truth=fine,
                picks=picks_b,
                frame_ms=frame_ms,
            ),
            compared(
                "c",
                "(e), (f) #C: the window slides to the left.",
                video,
                truth=fine,
                picks=picks_c,
                frame_ms=frame_ms,
            ),
            Picture(
                "close",
                _close(video, fine, picks_a[-2], picks_b[2], picks_c[-2]),
                "(c) the same bars close up.",
                narrow_in=NARROW_CLOSE_IN,
            ),
        ),
        rows=(
            same(
                "sub-steps kept",
                KEPT,
                " + ".join(_kept(outcome.provenance)),
                equal=" + ".join(_kept(outcome.provenance)) == KEPT,
            ),
            Row("#A, 54 × 54, 534 frames", "sliding clearly captured", f"{numbers['a_psnr_db']:.1f} dB"),
            Row("#B, 162 × 162", "target details explored", f"{numbers['b_psnr_db']:.1f} dB"),
            Row("#C, 54 × 54, 534 frames", "sliding clearly captured", f"{numbers['c_psnr_db']:.1f} dB"),
            statement(
                "bars resolved",
                "#B significantly better",
                f"#B {_named(resolved)}; error-free pixels of the size in #A and #C {_named(open_coarse)}",
                f"#B {in_elements(place_of(resolved) - place_of(open_coarse))}",
                hold=place_of(resolved) > place_of(open_coarse),
            ),
        ),
        seconds=dict(studio.seconds),
        numbers=numbers,
        movie={"ours": video[::16], "truth": fine[::16]},
        movie_ms=16 * frame_ms,
    )


def _named(element: str) -> str:
    group, _, number = element.partition("/")
    return f"to group {group}, element {number}" if number else "none"


def _kept(facts: dict[str, Any]) -> list[str]:
    return [str(part["end_substep"] - part["begin_substep"]) for part in facts["segments"]]


def _close(video: NDArray[Any], truth: NDArray[Any], a: int, b: int, c: int) -> Figure:
    drawing = canvas(3.6)
    axes = drawing.subplots(1, 5, width_ratios=[1.75, 1, 1, 1, 1])
    show(axes[0], truth[b])
    box(axes[0], *CLOSE)
    for ax, (name, frame) in zip(
        axes[1:], (("#A", video[a]), ("#B", video[b]), ("#C", video[c]), ("truth", truth[b])), strict=True
    ):
        show(ax, frame[CLOSE], title=name)
    return drawing
