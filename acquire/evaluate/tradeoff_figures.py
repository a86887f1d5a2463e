"""Plots of a trade-off, narrow enough for a phone.

The axes have a minimum range, so that a difference of a tenth of a decibel looks small.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from acquire.evaluate.figures import bare
from acquire.evaluate.knees import Clock, band, plain
from acquire.evaluate.themed import SOFT, SOLVER_COLOURS, STYLE, canvas

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.tradeoff import Point, TradeoffRun

    Series = tuple[str, str, str]

WIDTH_IN, HEIGHT_IN = 4.4, 3.3
CLOCKS: dict[Clock, str] = {"seconds": "wall time (s)", "processor_s": "processor time, all threads (s)"}
LINES = {"fast": ":", "balanced": "-", "best": "--"}
MARKERS = {"fast": "o", "balanced": "s", "best": "D"}
# With the truth there are six panels, in two rows of three.
FRAMES = 5
LEAST_OCTAVES, MANY_OCTAVES = 2.0, 3.5
"""Minimum range of a time axis, and range above which it has fewer ticks."""


@dataclass(frozen=True, slots=True)
class Metric:
    """A quantity of a `Point`: its label, the minimum range of its axis, and a floor if it is logarithmic."""

    name: str
    label: str
    least: tuple[float, float]
    """Lowest and highest value; for decibels, the second is the minimum range."""
    floor: float | None = None
    scale: float = 1.0


METRICS = (
    Metric("psnr_db", "PSNR (dB)", (0.0, 12.0)),
    Metric("ssim", "SSIM", (0.0, 1.0)),
    Metric("amplitude_error", "amplitude error (%)", (1.0, 100.0), 0.1, 100.0),
    Metric("frequency_error_hz", "frequency error (Hz)", (1.0, 100.0), 0.1),
)
DECIBELS = METRICS[0]


def known(runs: Sequence[TradeoffRun], metric: Metric) -> bool:
    """Return whether any run has a value of this metric; without a truth, none has."""
    return any(getattr(run.end, metric.name) is not None for run in runs)


def yardstick(runs: Sequence[TradeoffRun]) -> float | None:
    """Return the median PSNR of the truth's mean over time; None if unknown, or if the scene is constant."""
    known_db = [run.mean_db for run in runs if run.mean_db is not None]
    return float(np.median(known_db)) if known_db else None


def in_series(runs: Sequence[TradeoffRun]) -> dict[Series, list[TradeoffRun]]:
    """Group runs by solver, preset and dtype, so that repeats are together."""
    found: dict[Series, list[TradeoffRun]] = {}
    for run in runs:
        found.setdefault((run.solver, run.preset, run.dtype), []).append(run)
    return found


def curves(runs: Sequence[TradeoffRun], metric: Metric, clock: Clock) -> Figure:
    """Plot a quantity over time: the median of the repeats, their band, and the end of each run."""
    with mpl.rc_context(STYLE):
        figure = canvas(HEIGHT_IN, WIDTH_IN)
        ax = figure.subplots()
        solvers: list[str] = list(dict.fromkeys(run.solver for run in runs))
        for series, repeats in in_series(runs).items():
            _curve(ax, repeats, metric, clock, SOLVER_COLOURS[solvers.index(series[0]) % len(SOLVER_COLOURS)])
        if metric is DECIBELS and (mean_db := yardstick(runs)) is not None:
            ax.axhline(mean_db, color=SOFT, lw=1.2, ls=(0, (1, 1.5)), zorder=1, label="the truth's mean")
        ax.set_xscale("log")
        low, high = ax.get_xlim()
        # the middle of a logarithmic axis
        middle, octaves = np.sqrt(low * high), max(float(np.log2(high / low)), LEAST_OCTAVES)
        ax.set(xlim=(middle / 2 ** (octaves / 2), middle * 2 ** (octaves / 2)), xlabel=CLOCKS[clock])
        marks = (1, 2, 5) if octaves > MANY_OCTAVES else (1, 1.5, 2, 3, 5, 7)
        ax.xaxis.set_major_locator(LogLocator(subs=marks))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        # matplotlib also labels minor ticks where a logarithmic axis is short.
        ax.xaxis.set_minor_formatter(NullFormatter())
        _value_axis(ax, metric)
        # Empty lines for the legend: a solver has many curves and markers, and one entry.
        for line, solver in zip(SOLVER_COLOURS, solvers, strict=False):
            ax.plot([], [], color=line, lw=2.2, label=solver)
        handles, labels = ax.get_legend_handles_labels()
        shape = {"ncols": 4, "fontsize": 8.5, "handlelength": 1.3, "columnspacing": 1.0}
        figure.legend(handles, labels, loc="outside upper left", **shape)
        return figure


def _curve(ax: Axes, repeats: list[TradeoffRun], metric: Metric, clock: Clock, colour: str) -> None:
    found = band(repeats, metric.name, clock)
    if found is None:
        return
    low, middle, high = (_shown(values, metric) for values in (found.low, found.middle, found.high))
    run = repeats[0]
    ax.fill_between(found.times_s, low, high, color=colour, alpha=0.2, lw=0)
    # float64 has thin lines and hollow markers
    exact = run.dtype != "float32"
    ax.plot(
        found.times_s, middle, LINES.get(run.preset, "-"), color=colour, lw=1.0 if exact else 1.8, zorder=3
    )
    for each in repeats:
        value = getattr(each.end, metric.name)
        if value is None:
            continue
        # A run that was cut does not show what its preset can reach.
        marker = "x" if each.cut else MARKERS.get(each.preset, "o")
        at = getattr(each.end, clock), _shown(np.array([value]), metric)[0]
        ax.plot(*at, marker, color=colour, ms=6.5, mew=2, mfc="none" if exact else colour, zorder=4)


def _shown(values: NDArray[np.float64], metric: Metric) -> NDArray[np.float64]:
    scaled = values * metric.scale
    return scaled if metric.floor is None else np.maximum(scaled, metric.floor)


def _value_axis(ax: Axes, metric: Metric) -> None:
    ax.set_ylabel(metric.label)
    low, high = ax.get_ylim()
    least_low, least_high = metric.least
    if metric is DECIBELS:
        missing = max(0.0, least_high - (high - low)) / 2
        ax.set_ylim(low - missing, high + missing)
        ax.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        return
    if metric.floor is None:
        ax.set_ylim(min(low, least_low), max(high, least_high))
        return
    ax.set_yscale("log")
    ax.set_ylim(min(max(low, metric.floor), least_low) / 1.3, max(high, least_high) * 1.3)
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def frames(run: TradeoffRun, truth: NDArray[Any] | None) -> Figure:
    """Draw one frame after more and more time of one run, and the same frame of the truth."""
    # Up to five points, evenly spaced in the logarithm of time, including the first and the last.
    wanted = np.geomspace(run.points[0].seconds, run.points[-1].seconds, FRAMES)
    times = np.array([each.seconds for each in run.points])
    places = {int(np.argmin(np.abs(np.log(times / at)))) for at in wanted}
    points = [run.points[place] for place in sorted(places)]
    peak = white(run, truth)
    with mpl.rc_context(STYLE):
        figure = canvas(3.5, WIDTH_IN)
        axes = figure.subplots(2, 3).ravel()
        for ax in axes:
            bare(ax)
            ax.set_visible(False)
        shown = [(point.frame, in_caption(point)) for point in points]
        for ax, (frame, title) in zip(axes, [*shown, (truth, "truth")], strict=False):
            if frame is None:
                continue
            ax.set_visible(True)
            ax.imshow(frame, cmap="gray", vmin=0, vmax=peak)
            ax.spines[:].set(visible=True, color=SOFT)
            ax.set_title(title, fontsize=9.5, loc="left")
        return figure


def white(run: TradeoffRun, truth: NDArray[Any] | None) -> float:
    """Return the value that the pictures of a run show as white."""
    shown = run.end.frame if truth is None else truth
    assert shown is not None
    return float(np.quantile(shown, 0.999)) or 1.0


def in_caption(point: Point) -> str:
    """Return the time and the accuracy of a result, for a caption."""
    quality = "" if point.psnr_db is None else f": {point.psnr_db:.0f} dB"
    return f"{plain(point.seconds)} s{quality}"
