"""The figures of the report, modelled on Fig. 9 of the paper: line streams, frames, curves, PSNR over time.

Each function makes one matplotlib ``Figure`` from a :class:`~acquire.evaluate.result.DemoResult`;
:func:`save_figures` writes all of them as PNG and SVG. This module and `themed` are imported late, so that
commands without figures do not import matplotlib.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.ticker import MaxNLocator

from acquire.evaluate.curves import region_mean
from acquire.evaluate.themed import (
    HIGHLIGHT,
    INK,
    MASKED,
    SOLVER_COLOURS,
    STYLE,
    THEORY,
    canvas,
    save_drawing,
)
from acquire.lines import ARMS

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.curves import CurveComparison
    from acquire.evaluate.result import DemoResult
    from acquire.evaluate.themed import Drawing

FRAME_COLUMNS = 6
DETAIL_PERIODS = 3
DETAIL_SHARE = 0.1
ERROR_SHARE = 0.5
"""The scale of the error ends at this share of the peak."""

NARROW_LINES_IN, NARROW_FRAMES = 3.4, 0.5
"""On narrow pages: the height of the figure of lines, and the relative height of the figure of frames."""


def save_figures(result: DemoResult, directory: Path) -> dict[str, Drawing]:
    """Write lines, frames, curves (if there are regions) and psnr as PNG and SVG; return name → drawing."""
    makers = {"lines": line_streams, "frames": frames, "curves": intensity_curves, "psnr": psnr_over_time}
    if not result.regions:
        del makers["curves"]
    drawings = {}
    with mpl.rc_context(STYLE):
        for name, make in makers.items():
            figure = make(result)
            heights = {"lines": NARROW_LINES_IN, "frames": NARROW_FRAMES * figure.get_figheight()}
            drawings[name] = save_drawing(figure, directory, name, narrow_in=heights.get(name))
    return drawings


def line_streams(result: DemoResult) -> Figure:
    """Draw both arms' lines as pictures, with time downwards (Fig. 9a) and masked samples in colour."""
    segment, times = result.segment, result.line_ms
    figure = canvas(4.6)
    axes = figure.subplots(1, 2, sharey=True, squeeze=False)[0]
    usable = segment.lines[segment.mask]
    # of the samples in use: a single hot pixel would leave the others dark
    low, high = (float(usable.min()), float(usable.max())) if usable.size else (0.0, 1.0)
    half = np.diff(times).mean() / 2 if len(times) > 1 else 0.5
    # samples are centred on their pixel and their time
    extent = (-0.5, segment.geometry.stages - 0.5, times[-1] + half, times[0] - half)
    colours = mpl.colormaps["gray"].with_extremes(bad=MASKED)
    for arm, ax in enumerate(axes):
        values = np.ma.masked_where(~segment.mask[arm], segment.lines[arm])
        image = ax.imshow(values, cmap=colours, vmin=low, vmax=high, extent=extent, aspect="auto")
        ax.set_title(f"Camera {ARMS[arm].upper()}")
        masked = np.count_nonzero(~segment.mask[arm])
        if masked:
            ax.set_title(f"{masked} masked", loc="right", color=MASKED, fontsize=8.5, fontweight="normal")
        ax.set_xlabel("pixel of the line")
        ax.grid(visible=False)
    axes[0].set_ylabel("time since start (ms)")
    figure.colorbar(image, ax=list(axes), label="recorded value (DN)", pad=0.015, aspect=30)
    return figure


def frames(result: DemoResult) -> Figure:
    """Draw representative frames (Fig. 9b): the truth, then each solver above its absolute error."""
    rows = [("truth", result.truth, False)]
    for solver in result.solvers:
        error = np.abs(solver.video - result.truth)
        rows += [(solver.label.replace(" (", "\n("), solver.video, False), ("|error|", error, True)]
    picks = representative_frames(result)
    aspect = result.truth.shape[1] / result.truth.shape[2]
    figure = canvas(0.3 + 1.5 * aspect * len(rows))
    axes = figure.subplots(len(rows), len(picks), squeeze=False)
    for (label, video, is_error), row in zip(rows, axes, strict=True):
        for frame, ax in zip(picks, row, strict=True):
            look, white = ("inferno", ERROR_SHARE) if is_error else ("gray", 1.0)
            ax.imshow(video[frame], cmap=look, vmin=0, vmax=white * result.peak)
            bare(ax)
        row[0].set_ylabel(label, fontsize=8, fontweight="normal" if is_error else "bold")
    for frame, ax in zip(picks, axes[0], strict=True):
        stamp(ax, f"#{frame}\n{result.frame_ms[frame]:.2f} ms")
    _colour_bar(figure, axes[0], "intensity", "neither")
    # the third row is the error of the first solver
    # An arrow at the end of the scale: larger errors than `ERROR_SHARE` have the same colour.
    _colour_bar(figure, axes[2], "|error|", "max")
    return figure


def intensity_curves(result: DemoResult) -> Figure:
    """Plot the mean intensity of each region against theory (Fig. 9c).

    Each row shows the region, the whole curve, a detail of a few periods, and the fits.
    """
    figure = canvas(0.7 + 1.45 * len(result.regions))
    axes = figure.subplots(len(result.regions), 3, squeeze=False, width_ratios=[1, 4.6, 2.1])
    first, last = result.frame_ms[0], result.frame_ms[-1]
    for row, (where, whole, detail) in enumerate(axes):
        region, curve = result.regions[row], result.solvers[0].curves[row]
        # a few periods around the middle of the video; of what does not blink, a share of it
        share_ms = DETAIL_SHARE * (last - first)
        wanted_ms = share_ms if curve.constant else DETAIL_PERIODS * 1e3 / curve.theory.frequency_hz
        half = min(wanted_ms, last - first) / 2
        window = (first + last) / 2 - half, (first + last) / 2 + half
        where.imshow(result.truth.mean(axis=0), cmap="gray", vmin=0)
        if not region.mask.all():  # a region without an edge has no contour
            where.contour(region.mask, levels=[0.5], colors=HIGHLIGHT, linewidths=1.2)
        where.set_ylabel(region.name, fontweight="bold")
        bare(where)
        _plot_curves(whole, result, row)
        whole.axvspan(*window, color=HIGHLIGHT, alpha=0.2, lw=0)
        whole.set(xlim=(first, last), ylabel="intensity")
        whole.tick_params(labelbottom=row == len(axes) - 1)
        _plot_curves(detail, result, row)
        detail.set_xlim(*window)
        detail.tick_params(labelleft=False)
        detail.xaxis.set_major_locator(MaxNLocator(2))
        set_text = "constant" if region.set_hz is None else f"set {region.set_hz:.0f} Hz"
        texts = [(set_text, INK)]
        texts += [(_fit_text(solver.curves[row]), colour) for solver, colour in _coloured(result)]
        for i, (text, colour) in enumerate(texts):
            y = 0.5 + 0.22 * ((len(texts) - 1) / 2 - i)
            detail.text(1.05, y, text, color=colour, fontsize=9, va="center", transform=detail.transAxes)
    axes[0, 2].set_title("detail")
    figure.supxlabel("time since start (ms)", fontsize=9.5)
    handles, labels = axes[0, 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


def psnr_over_time(result: DemoResult) -> Figure:
    """Plot the PSNR of each frame for every solver, and the PSNR of the whole video as a dashed line."""
    figure = canvas(2.9)
    ax = figure.subplots()
    for solver, colour in _coloured(result):
        ax.plot(result.frame_ms, solver.psnr_per_frame, color=colour, lw=1.1, label=solver.label)
        # Of the whole video, which is not the mean of these: the errors are averaged, and not their decibels.
        ax.axhline(solver.psnr_db, color=colour, lw=0.9, ls=(0, (5, 4)))
    ax.set_xlim(result.frame_ms[0], result.frame_ms[-1])
    ax.set_xlabel("time since start (ms)")
    ax.set_ylabel("PSNR (dB)")
    figure.legend(loc="outside upper right", ncols=len(result.solvers))
    return figure


def representative_frames(result: DemoResult, count: int = FRAME_COLUMNS) -> NDArray[np.int64]:
    """Return indices (count,) spread over one period of the slowest region, or else over the whole video."""
    total = len(result.frame_ms)
    rates = [curve.theory.frequency_hz for curve in result.solvers[0].curves if not curve.constant]
    # in frames
    period = round(1e6 / (min(rates) * result.frame_interval_us)) if rates else 0
    if not count <= period <= total:
        return np.linspace(0, total - 1, min(count, total)).round().astype(np.int64)
    first = min(total // 2, total - period)
    return first + (np.arange(count) * period) // count


def _colour_bar(figure: Figure, row: NDArray[Any], label: str, extend: str) -> None:
    image = row[-1].get_images()[0]
    figure.colorbar(image, ax=list(row), label=label, extend=extend, pad=0.01, aspect=11, shrink=0.9)


def _plot_curves(ax: Axes, result: DemoResult, row: int) -> None:
    region = result.regions[row]
    # theory and measurement share one scale, so that a lost amplitude shows
    scale = float(np.max(np.abs(region.theory))) or 1.0
    ax.plot(result.frame_ms, region.theory / scale, color=THEORY, lw=3.0, label="theory")
    for rank, (solver, colour) in enumerate(_coloured(result)):
        measured = region_mean(solver.video, region.mask) / scale
        # the default solver comes first in the legend and is drawn on top
        ax.plot(result.frame_ms, measured, color=colour, lw=1.0, label=solver.label, zorder=3 - 0.1 * rank)
    ax.set_ylim(min(0.0, ax.get_ylim()[0]), max(1.05, ax.get_ylim()[1]))


def _fit_text(curve: CurveComparison) -> str:
    if curve.amplitude_ratio is not None:
        return f"{curve.measured.frequency_hz:.1f} Hz × {curve.amplitude_ratio:.2f}"
    return "–" if curve.level_ratio is None else f"level × {curve.level_ratio:.2f}"


def _coloured(result: DemoResult) -> list[tuple[Any, str]]:
    colours = [SOLVER_COLOURS[i % len(SOLVER_COLOURS)] for i in range(len(result.solvers))]
    return list(zip(result.solvers, colours, strict=True))


def bare(ax: Axes) -> None:
    """Remove ticks, grid and frame from a picture."""
    ax.set(xticks=[], yticks=[])
    ax.grid(visible=False)
    for spine in ax.spines.values():
        spine.set_visible(False)


def stamp(ax: Axes, text: str) -> None:
    """Write the time above a picture."""
    ax.set_title(text, fontsize=7.5, fontweight="normal", pad=3)
