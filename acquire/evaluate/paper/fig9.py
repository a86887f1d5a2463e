"""Fig. 9: Scene #1, four LEDs, three of them driven by sinusoids of 5, 2.5 and 1 kHz."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.evaluate.curves import CurveComparison, compare_curve, region_mean
from acquire.evaluate.paper.comparison import Row, frequency, same, statement
from acquire.evaluate.paper.drawing import strip
from acquire.evaluate.paper.studio import PaperFigure, Picture
from acquire.evaluate.themed import SOLVER_COLOURS, THEORY, canvas
from acquire.sim.leds import LedScene

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.paper.studio import Studio
    from acquire.lines import Segment

# 52 ms at 33.3 kHz, where the paper's lines begin; 263 lines give its 598 frames.
FIRST_LINE, LINES = 1733, 263
# Voxels on a shape's edge mix light and dark.
INNER = 0.9
DETAIL_MS = 1.2
FRAMES = 598
STEADY = 0.05
"""Largest ripple of a constant LED, relative to its level."""


def figure(studio: Studio) -> PaperFigure:
    """Reconstruct lines from 52 ms to 59.89 ms, which give frames from 52 ms to 57.98 ms."""
    shot = studio.shoot("scene-leds", FIRST_LINE, LINES, "Scene #1")
    scene, segment, video, truth = shot.scene, shot.segment, shot.video, shot.truth
    assert isinstance(scene, LedScene)
    light = scene.intensity(shot.first_substep, len(video))
    masks = scene.masks.reshape(-1, 64, 3, 64, 3).mean(axis=(2, 4)) >= INNER
    measured = [region_mean(video, mask) for mask in masks]
    curves = [
        compare_curve(led.name, theory, found, segment.substep_ns * 1e-9)
        for led, theory, found in zip(scene.leds, light, measured, strict=True)
    ]
    times = shot.times_ms
    # over the circle's period of 1 ms, which is 100 frames
    picks = 250 + np.arange(6) * 17
    return PaperFigure(
        name="fig9",
        title="Scene #1: four LEDs",
        text="263 lines of both cameras, 52 ms to 59.89 ms after the start; 598 frames of 64 × 64 voxels, "
        "10 µs apart, from 52 ms to 57.98 ms.",
        pictures=(
            Picture("lines", _lines(segment, times[0]), "(a) the lines recorded by the two cameras."),
            strip(
                "frames",
                "(b) frames over one period of the circle.",
                (("ours", video[picks]), ("truth", truth[picks])),
                [f"#{frame}  {times[frame]:.2f} ms" for frame in picks],
                float(truth.max()),
            ),
            Picture(
                "curves", _curves(times, light, measured, curves), "(c) mean light of each shape over time."
            ),
        ),
        rows=(
            same(
                "video",
                "64 × 64 × 598, 52 to 57.98 ms",
                f"64 × 64 × {len(video)}, {times[0]:.2f} to {times[-1]:.2f} ms",
                equal=len(video) == FRAMES,
            ),
            *(_row(curve) for curve in curves),
            # The circle is the third lamp of scene-leds, and the one that is driven into saturation.
            statement(
                "distortion of the circle",
                "slight, from saturation",
                f"{curves[2].measured.distortion:.1%} (true {curves[2].theory.distortion:.1%})",
                f"{abs(curves[2].measured.distortion - curves[2].theory.distortion):.1%} from the truth; "
                "half of the true distortion is allowed",
                hold=abs(curves[2].measured.distortion / curves[2].theory.distortion - 1) <= 0.5,
            ),
            shot.accuracy(),
        ),
        seconds=dict(studio.seconds),
        numbers=shot.numbers(),
        # three of the circle's periods, every second frame of 10 µs
        movie={"ours": video[100:400:2], "truth": truth[100:400:2]},
        movie_ms=0.02,
    )


def _row(curve: CurveComparison) -> Row:
    if curve.constant:
        ripple = curve.measured.residual_rms / curve.measured.offset
        return statement(
            f"{curve.name}: constant",
            "constant",
            f"level × {curve.level_ratio or 0:.3f}",
            f"ripple {ripple:.1%}; {STEADY:.0%} is allowed",
            hold=ripple <= STEADY,
        )
    return frequency(
        f"{curve.name}: {curve.theory.frequency_hz:.0f} Hz",
        "same frequency as theory",
        f"{curve.measured.frequency_hz:.1f} Hz, amplitude × {curve.amplitude_ratio or 0:.2f}",
        curve.measured.frequency_hz,
        curve.theory.frequency_hz,
    )


def _lines(segment: Segment, start_ms: float) -> Figure:
    drawing = canvas(3.6)
    axes = drawing.subplots(1, 2, sharey=True)
    # a line has three sub-steps of 10 µs
    extent = (-0.5, 63.5, start_ms + LINES * 0.03, start_ms)
    for ax, lines, name in zip(axes, segment.lines, "AB", strict=True):
        ax.imshow(lines, cmap="gray", aspect="auto", extent=extent)
        ax.set(title=f"camera {name}", xlabel="pixel of the line")
        ax.grid(visible=False)
    axes[0].set_ylabel("time (ms)")
    return drawing


def _curves(
    times: NDArray[Any],
    light: NDArray[Any],
    measured: list[NDArray[np.float64]],
    curves: list[CurveComparison],
) -> Figure:
    drawing = canvas(5.4)
    axes = drawing.subplots(len(curves), 2, sharex="col", width_ratios=[2.4, 1])
    middle = times[len(times) // 2]
    for pair, theory, found, curve in zip(axes, light, measured, curves, strict=True):
        for ax in pair:
            ax.plot(times, theory, color=THEORY, lw=3, label="theory")
            ax.plot(times, found, color=SOLVER_COLOURS[0], lw=1.1, label="ours")
            ax.set_ylim(0, 1.08)
        pair[0].set_ylabel(curve.name, fontweight="bold")
        pair[1].set_xlim(middle - DETAIL_MS / 2, middle + DETAIL_MS / 2)
        pair[1].tick_params(labelleft=False)
    axes[0, 0].set_xlim(times[0], times[-1])
    for ax in axes[-1]:
        ax.set_xlabel("time (ms)")
    drawing.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return drawing
