"""The trade-off on one page: curves of accuracy against time with the Pareto front, and the table."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
from matplotlib.ticker import FuncFormatter, LogFormatter, MaxNLocator

from acquire.evaluate.figures import DPI, HIGHLIGHT, SOLVER_COLOURS, STYLE
from acquire.evaluate.paper.drawing import canvas
from acquire.evaluate.report import fill_template
from acquire.evaluate.tradeoff import pareto, table

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acquire.evaluate.tradeoff import Point, Run
    from acquire.recon.segments import Voxels
    from acquire.simulate import Study

METRICS = (
    ("psnr_db", "PSNR (dB)", False),
    ("ssim", "SSIM", False),
    ("amplitude_error", "amplitude error", True),
    ("frequency_error_hz", "frequency error (Hz)", True),
)
"""Name, label, and whether its axis is logarithmic."""
MARKERS = {"fast": "o", "balanced": "s", "best": "D"}


def write_page(
    runs: Sequence[Run], study: Study | None, directory: Path, title: str, command: str, when: datetime
) -> Path:
    """Write ``index.html``, ``tradeoff.csv``, ``tradeoff.json`` and the pictures into ``directory``."""
    rows = table(runs)
    facts: dict[str, Any] = {
        "title": title,
        "command": command,
        "when": when.isoformat(timespec="seconds"),
        "rows": rows,
        "study": _study_facts(study),
    }
    text = json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False)
    (directory / "tradeoff.json").write_text(text + "\n", encoding="utf-8")
    with (directory / "tradeoff.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    pictures = {}
    with mpl.rc_context(STYLE):
        drawings = {f"curves-{voxels}": _curves(runs, voxels) for voxels in _kinds(runs)}
        if study is not None and study.effects:
            drawings["effects"] = _effects(study)
        for name, drawing in drawings.items():
            pictures[name] = directory / f"{name}.png"
            drawing.savefig(pictures[name], dpi=DPI)
    ends = [row for row in rows if row["preset"]]
    facts |= {"ends": ends, "kinds": [str(voxels) for voxels in _kinds(runs)]}
    page = directory / "index.html"
    page.write_text(fill_template("tradeoff.html.j2", facts, pictures), encoding="utf-8")
    return page


def _kinds(runs: Sequence[Run]) -> list[Voxels]:
    return list(dict.fromkeys(run.voxels for run in runs))


def _curves(runs: Sequence[Run], voxels: Voxels) -> Figure:
    """All metrics over time for one kind of voxels; a curve per solver and dtype, and the front."""
    own = [run for run in runs if run.voxels == voxels]
    shown = [each for each in METRICS if any(getattr(run.end, each[0]) is not None for run in own)]
    figure = canvas(3.1 * -(-len(shown) // 2) + 0.4)
    axes = figure.subplots(-(-len(shown) // 2), 2, squeeze=False).ravel()
    colours = {
        run.solver: SOLVER_COLOURS[i] for i, run in enumerate({run.solver: run for run in own}.values())
    }
    for ax, (name, label, logarithmic) in zip(axes, shown, strict=False):
        for run in own:
            _curve(ax, run, name, colours[run.solver])
        ax.set(xscale="log", ylabel=label, xlabel="wall time (s)", yscale="log" if logarithmic else "linear")
        ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        ax.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))
        if not logarithmic:
            ax.yaxis.set_major_locator(MaxNLocator(6))
    _front(axes[0], pareto(own))
    for ax in axes[len(shown) :]:
        ax.set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(5, len(labels)))
    return figure


def _curve(ax: Axes, run: Run, name: str, colour: str) -> None:
    points = [
        (point.seconds, getattr(point, name)) for point in run.points if getattr(point, name) is not None
    ]
    if not points:
        return
    times, values = ([each[i] for each in points] for i in (0, 1))
    single = run.dtype == "float32"
    label = run.solver if single else f"{run.solver}, {run.dtype}"
    ax.plot(times, values, ".-" if single else ".:", color=colour, lw=1.4, ms=4, label=label)
    filled = colour if single else "white"
    for point in run.points:
        if point.presets and getattr(point, name) is not None:
            marker = MARKERS.get(point.presets[-1], "o")
            ax.plot(point.seconds, getattr(point, name), marker, color=colour, ms=7, mfc=filled)


def _front(ax: Axes, front: list[tuple[Run, Point]]) -> None:
    if not front:
        return
    times = [point.seconds for _, point in front]
    values = [point.psnr_db or 0.0 for _, point in front]
    ax.step(times, values, where="post", color=HIGHLIGHT, lw=6, alpha=0.45, zorder=0, label="Pareto front")


def _effects(study: Study) -> Figure:
    """What each effect of the simulator changes in the lines, against what it costs."""
    figure = canvas(3.4)
    ax = figure.subplots()
    known = [worth for worth in study.effects if worth.noises is not None]
    costs = [max(worth.us_per_line, 1e-3) for worth in known]
    sizes = [max(worth.noises or 0.0, 1e-4) for worth in known]
    ax.plot(costs, sizes, "o", color=SOLVER_COLOURS[0], ms=7)
    for worth, cost, size in zip(known, costs, sizes, strict=True):
        label = worth.effect.replace("_", " ")
        ax.annotate(label, (cost, size), textcoords="offset points", xytext=(7, 4), fontsize=8.5)
    ax.axhspan(
        ax.get_ylim()[0] if min(sizes) > 0.05 else min(sizes) / 3, 0.05, color="#e4e7eb", zorder=0, lw=0
    )
    ax.set(
        xscale="log",
        yscale="log",
        xlabel="cost (µs per line and arm)",
        ylabel="error of the lines without it\n(in their noise)",
        xlim=(min(costs) / 1.6, max(costs) * 3),
    )
    return figure


def _study_facts(study: Study | None) -> dict[str, Any] | None:
    if study is None:
        return None
    return {
        "noise_dn": study.noise_dn,
        "signal_dn": study.signal_dn,
        "bare_us_per_line": study.bare_us_per_line,
        "all_us_per_line": study.all_us_per_line,
        "effects": [
            {
                "effect": worth.effect,
                "place": worth.place,
                "change_dn": worth.change_dn,
                "noises": worth.noises,
                "us_per_line": worth.us_per_line,
            }
            for worth in study.effects
        ],
    }
