"""Fig. 10: Scene #2, two seven-segment displays whose digits appear and disappear."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.evaluate.curves import region_mean
from acquire.evaluate.paper.comparison import Row, captured, statement
from acquire.evaluate.paper.drawing import box, correlation, show, strip
from acquire.evaluate.paper.studio import PaperFigure, Picture
from acquire.evaluate.themed import SOLVER_COLOURS, THEORY, canvas
from acquire.sim.digits import SEGMENTS, DigitScene

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.paper.studio import Studio

# 52 ms at 33.3 kHz, and 598 trusted frames, as in Fig. 9.
FIRST_LINE, LINES = 1733, 263
# The 1.28 ms of a digit, in frames of 10 µs.
PERIOD_FRAMES = 128
LIT = 0.4
"""A segment counts as lit at this share of the brightest of its display."""
BOXES = {
    "left, middle bar": ("left", "g"),
    "right, lower right": ("right", "c"),
    "right, middle bar": ("right", "g"),
}
"""Segments whose light is plotted → display and segment."""
PAPER = {
    "left, middle bar": "a continuous triangular wave",
    "right, lower right": "a continuous triangular wave",
    "right, middle bar": "intermittent",
}
"""The paper's statements about their light."""


def figure(studio: Studio) -> PaperFigure:
    """Show the digits at their peaks, and the light of three segments over time."""
    shot = studio.shoot("scene-digits", FIRST_LINE, LINES, "Scene #2")
    scene, video, truth, times = shot.scene, shot.video, shot.truth, shot.times_ms
    assert isinstance(scene, DigitScene)
    masks = _masks(scene)
    peaks = {side: _peaks(truth, masks, side) for side in ("left", "right")}
    digits = {
        side: (
            "".join(_read(video[p], masks, side) for p in at),
            "".join(_read(truth[p], masks, side) for p in at),
        )
        for side, at in peaks.items()
    }
    curves = {
        name: (region_mean(video, masks[key]), region_mean(truth, masks[key])) for name, key in BOXES.items()
    }
    # Four digits of either display.
    picks = np.sort(np.concatenate([peaks["left"], peaks["right"]]))[:8]
    agreement = {name: correlation(*pair) for name, pair in curves.items()}
    return PaperFigure(
        name="fig10",
        title="Scene #2: two seven-segment displays",
        text="2-4-6-8 on the left, 1-3-5-7 on the right. Each digit rises and falls within 1.28 ms, and the "
        "displays are half a period apart. 598 frames of 64 × 64 voxels from 263 lines.",
        pictures=(
            strip(
                "frames",
                "(b) frames at the peaks of the digits.",
                (("ours", video[picks]), ("truth", truth[picks])),
                [f"{times[p]:.2f} ms" for p in picks],
            ),
            Picture(
                "curves", _curves(times, curves, truth, masks), "(c) mean light of three segments over time."
            ),
        ),
        rows=(
            *(_reading(side, *digits[side]) for side in ("left", "right")),
            *(captured(f"{name}: light over time", PAPER[name], r) for name, r in agreement.items()),
            shot.accuracy(),
        ),
        seconds=dict(studio.seconds),
        numbers=shot.numbers(),
        # every fourth frame of 10 µs
        movie={"ours": video[::4], "truth": truth[::4]},
        movie_ms=0.04,
    )


def _reading(side: str, read: str, shown: str) -> Row:
    right = sum(one == other for one, other in zip(read, shown, strict=True))
    return statement(
        f"{side} display reads",
        "identified",
        f"{read} (shown {shown})",
        f"{right} of {len(shown)} digits",
        hold=right == len(shown),
    )


def _masks(scene: DigitScene) -> dict[tuple[str, str], NDArray[np.bool_]]:
    """Return the voxels covered by each segment that is ever lit, by display and segment."""
    # share of each voxel of N_m = 3 that a segment covers
    covered = scene.masks.reshape(-1, 64, 3, 64, 3).mean(axis=(2, 4))
    sides = ["left" if display.column < 0.5 else "right" for display, _ in scene.segments]
    return {
        (side, name): mask >= max(0.6, 0.9 * float(mask.max()))
        for side, (_, name), mask in zip(sides, scene.segments, covered, strict=True)
    }


def _peaks(
    truth: NDArray[Any], masks: dict[tuple[str, str], NDArray[np.bool_]], side: str
) -> NDArray[np.int64]:
    """Return the frames at which a digit of a display is brightest."""
    own = np.any([mask for (where, _), mask in masks.items() if where == side], axis=0)
    light = truth[:, own].max(axis=1)
    peaks = [
        t
        for t in range(8, len(light) - 8)
        if light[t] == light[t - 8 : t + 9].max() and light[t] > 0.9 * light.max()
    ]
    # a plateau of equal light counts once
    kept = [
        t
        for t, before in zip(peaks, [-PERIOD_FRAMES, *peaks], strict=False)
        if t - before > PERIOD_FRAMES // 2
    ]
    return np.array(kept)


def _read(frame: NDArray[Any], masks: dict[tuple[str, str], NDArray[np.bool_]], side: str) -> str:
    """Read the digit that a display shows; ``?`` if its lit segments form none."""
    light = {name: float(frame[mask].mean()) for (where, name), mask in masks.items() if where == side}
    lit = {name for name, value in light.items() if value > LIT * max(light.values())}
    return next((str(digit) for digit, names in enumerate(SEGMENTS) if set(names) == lit), "?")


def _curves(
    times: NDArray[Any],
    curves: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]],
    truth: NDArray[Any],
    masks: dict[tuple[str, str], NDArray[np.bool_]],
) -> Figure:
    drawing = canvas(4.2)
    axes = drawing.subplots(len(curves), 2, width_ratios=[1, 4.6], sharex="col")
    for (where, ax), (name, (found, theory)) in zip(axes, curves.items(), strict=True):
        show(where, truth.max(axis=0), float(truth.max()))
        rows, columns = (np.flatnonzero(masks[BOXES[name]].any(axis=axis)) for axis in (1, 0))
        box(where, slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        ax.plot(times, theory, color=THEORY, lw=3, label="theory")
        ax.plot(times, found, color=SOLVER_COLOURS[0], lw=1.2, label="ours")
        ax.set_title(name, fontsize=9.5)
        ax.set(xlim=(times[0], times[-1]), ylabel="light")
    axes[-1, 1].set_xlabel("time (ms)")
    drawing.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return drawing
