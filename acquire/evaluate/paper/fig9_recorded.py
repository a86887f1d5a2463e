"""Fig. 9 from a recording of four lamps in the quarters of the field, by any instrument and without a scene
file.

Each lamp is identified by the frequency of its light, the brightest light in its quarter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np

from acquire.calibrate.apply import calibrated
from acquire.calibrate.choose import choose, corrected
from acquire.errors import UsageError
from acquire.evaluate.curves import HARMONICS, SineFit, fit_constant, fit_sine, region_mean
from acquire.evaluate.paper.comparison import Row, frequency, same, statement
from acquire.evaluate.paper.drawing import strip
from acquire.evaluate.paper.studio import PaperFigure, Picture
from acquire.evaluate.themed import SOLVER_COLOURS, STYLE, THEORY, canvas

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.paper.studio import Studio
    from acquire.store import Recording

LAMPS = {"x": 5000.0, "triangle": 2500.0, "circle": 1000.0, "equals": 0.0}
"""The lamps of Scene #1 and their frequencies (Hz); 0 is constant."""
NEAR = 0.05
"""Largest relative difference of a frequency that still identifies a lamp."""
STEADY = 0.1
"""Amplitude relative to the mean below which a lamp is constant."""
LIT, FAINT = 0.5, 0.15
"""Least light of a lamp's voxel relative to its quarter's brightest, and of a lamp relative to the field."""
LINES = 263
QUARTERS = ("upper left", "upper right", "lower left", "lower right")


@dataclass(frozen=True, slots=True, eq=False)
class Lamp:
    """The lamp in one quarter: its mean light over time and its fit; ``name`` is None if it is unknown."""

    place: str
    light: NDArray[np.float64]
    fit: SineFit
    name: str | None


@mpl.rc_context(STYLE)
def figure_of(recording: Recording, studio: Studio, first_line: int | None = None) -> PaperFigure:
    """Make Fig. 9 from 263 lines of the recording, corrected by the calibration that it carries.

    Raises UsageError for too few lines, and if fewer than two quarters are lit.
    """
    first = recording.first_available_line if first_line is None else first_line
    have = recording.first_line + recording.lines - first
    if have < LINES:
        raise UsageError(
            f"{recording} has {have} lines, starting with line {first}", possible=f"{LINES} or more"
        )
    chosen = choose(recording)
    segment = recording.cut(first, LINES)
    if chosen is not None:
        segment = calibrated(segment, chosen.calibration)
    geometry = segment.geometry
    result = studio.solve(segment, geometry.substeps, 1, "the recording")
    video = np.asarray(result.video[result.trusted], np.float64)
    if len(video) < 2:
        raise UsageError(f"{recording} has no trusted frames: {'; '.join(result.warnings)}")
    interval_s = segment.substep_ns * 1e-9
    lamps = list(_lamps(video, interval_s))
    if len(lamps) < 2:
        raise UsageError(
            f"only {len(lamps)} of the field's quarters are lit",
            possible="Scene #1, with a lamp in each of the four quarters",
        )
    times_ms = np.arange(len(video), dtype=np.float64) * (interval_s * 1e3)
    picks = np.linspace(0, len(video) - 1, 6).astype(int)
    stamps = [f"{times_ms[k]:.2f} ms" for k in picks]
    white = float(np.percentile(video, 99.9))
    frames = strip("frames", "(b) frames over the whole time.", (("frames", video[picks]),), stamps, white)
    applied = "nothing" if chosen is None else ", ".join(corrected(chosen.calibration)) or "nothing"
    return PaperFigure(
        name="fig9",
        title=f"Scene #1, from {recording}",
        text=f"{LINES} lines of both cameras, starting with line {first}; {len(video)} frames of "
        f"{video.shape[1]} × {video.shape[2]} voxels. Corrected: {applied}.",
        pictures=(
            frames,
            Picture(
                "curves", _curves(times_ms, interval_s, lamps), "(c) mean light of each lamp and its fit."
            ),
        ),
        rows=(
            same(
                "video",
                "64 × 64 × 598",
                f"{video.shape[1]} × {video.shape[2]} × {len(video)}",
                equal=video.shape == (598, 64, 64),
            ),
            *_rows(lamps),
            *(Row("warning", "–", text) for text in result.warnings),
        ),
        seconds=dict(studio.seconds),
        numbers={f"{lamp.place}_hz": lamp.fit.frequency_hz for lamp in lamps},
        # The page shows 1 as white.
        movie={"reconstructed": video[::4] / white},
        movie_ms=4 * interval_s * 1e3,
    )


def _lamps(video: NDArray[np.float64], interval_s: float) -> Iterator[Lamp]:
    """Yield the lamps of the lit quarters, row by row."""
    mean = np.maximum(video.mean(axis=0), 0)
    rows, columns = np.indices(mean.shape)
    quarter = 2 * (rows >= mean.shape[0] // 2) + (columns >= mean.shape[1] // 2)
    for number, place in enumerate(QUARTERS):
        inside = quarter == number
        # Not the maximum, which one voxel of noise would decide.
        bright = float(np.percentile(mean[inside], 98))
        if bright <= FAINT * float(np.percentile(mean, 99)):
            continue
        light = region_mean(video, inside & (mean > LIT * bright))
        fit = fit_sine(light, interval_s, harmonics=HARMONICS)
        if fit.amplitude < STEADY * fit.offset:
            fit = fit_constant(light)
        # a fitted constant has frequency 0, to which only the constant lamp is near
        # At most one: the lamps' frequencies differ by factors of 2 and more.
        near = (name for name, hz in LAMPS.items() if abs(fit.frequency_hz - hz) <= NEAR * hz)
        yield Lamp(place, light, fit, next(near, None))


def _rows(lamps: list[Lamp]) -> list[Row]:
    rows = []
    for name, hz in LAMPS.items():
        lamp = next((each for each in lamps if each.name == name), None)
        what = f"{name}: {f'{hz:.0f} Hz' if hz else 'constant'}"
        paper = "same frequency as theory" if hz else "constant"
        if lamp is None or not hz:
            rows.append(statement(what, paper, _described(lamp), hold=lamp is not None))
        else:
            rows.append(frequency(what, paper, _described(lamp), lamp.fit.frequency_hz, hz))
    unknown = [lamp for lamp in lamps if lamp.name is None]
    return rows + [Row(f"{lamp.place}: none of these", "–", _described(lamp)) for lamp in unknown]


def _described(lamp: Lamp | None) -> str:
    if lamp is None:
        return "not found"
    fit = lamp.fit
    if not fit.amplitude:
        return f"constant, ripple {fit.residual_rms / fit.offset:.1%}, {lamp.place}"
    return f"{fit.frequency_hz:.1f} Hz, amplitude {fit.amplitude / fit.offset:.0%} of the mean, {lamp.place}"


def _curves(times_ms: NDArray[Any], interval_s: float, lamps: list[Lamp]) -> Figure:
    drawing = canvas(0.6 + 1.2 * len(lamps))
    axes = drawing.subplots(len(lamps), 1, sharex=True, squeeze=False)[:, 0]
    at_s = np.arange(len(times_ms)) * interval_s
    for ax, lamp in zip(axes, lamps, strict=True):
        ax.plot(times_ms, lamp.fit.at(at_s), color=THEORY, lw=3, label="fit")
        ax.plot(times_ms, lamp.light, color=SOLVER_COLOURS[0], lw=1.1, label="recording")
        ax.set_ylim(0, 1.15 * float(lamp.light.max()))
        ax.set_ylabel(lamp.name or lamp.place, fontweight="bold")
    axes[0].set_xlim(times_ms[0], times_ms[-1])
    axes[-1].set_xlabel("time (ms)")
    drawing.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return drawing
