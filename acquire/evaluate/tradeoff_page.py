"""The trade-off on one page: accuracy against time as sentences, curves and frames, and a table."""

from __future__ import annotations

import csv
import json
from statistics import median
from typing import TYPE_CHECKING, Any

import matplotlib as mpl

from acquire.evaluate.knees import sentences
from acquire.evaluate.page import fill_template
from acquire.evaluate.player import beside, clip_of
from acquire.evaluate.themed import GRID, SOLVER_COLOURS, STYLE, canvas, save_drawing
from acquire.evaluate.tradeoff import table
from acquire.evaluate.tradeoff_figures import (
    METRICS,
    curves,
    frames,
    in_caption,
    in_series,
    known,
    white,
    yardstick,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from datetime import datetime
    from pathlib import Path

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.knees import Clock
    from acquire.evaluate.themed import Drawing
    from acquire.evaluate.tradeoff import TradeoffRun
    from acquire.evaluate.tradeoff_figures import Metric
    from acquire.recon.segments import Voxels
    from acquire.simulate import Study

    Truths = Mapping[tuple[str, Voxels], NDArray[Any] | None]

SHOWN_MS = 400
"""Time for which the player shows each result."""
QUANTITIES = ("seconds", "processor_s", "psnr_db", "ssim", "amplitude_error", "frequency_error_hz")


def write_page(
    runs: Sequence[TradeoffRun],
    truths: Truths,
    study: Study | None,
    *,
    directory: Path,
    heading: dict[str, Any],
    when: datetime,
) -> Path:
    """Write ``index.html``, ``tradeoff.csv``, ``tradeoff.json`` and the plots into ``directory``.

    ``truths`` are the true frames that correspond to the frames shown; ``heading`` has ``title``,
    ``command``, ``notes`` (sentences about the whole page) and ``host`` (the load of the machine).
    """
    rows = table(runs)
    facts: dict[str, Any] = {
        **heading,
        "when": when.isoformat(timespec="seconds"),
        "rows": rows,
        "study": _study_facts(study),
        "sections": [],
    }
    drawings: dict[str, Drawing] = {}
    movies = []
    for number, (case, voxels) in enumerate(dict.fromkeys((run.case, run.voxels) for run in runs)):
        own = [run for run in runs if (run.case, run.voxels) == (case, voxels)]
        # `truths` are those of the first repeat: every other one has another draw of the scene
        shown = max((run for run in own if run.repeat == 0), key=lambda run: run.end.psnr_db or 0.0)
        truth = truths.get((case, voxels))
        drawn = _draw(own, shown, truth, f"case-{number}")
        for name, (_, figure) in drawn.items():
            drawings[name] = save_drawing(figure, directory, name)
        movies.append(_movie(shown, truth))
        facts["sections"].append(
            {
                "case": case,
                "voxels": str(voxels),
                "shown": f"{shown.solver}, {shown.preset}",
                "sentences": [
                    *(text for repeats in in_series(own).values() for text in sentences(repeats)),
                    *_still_sentence(own),
                ],
                "ends": [_end(repeats) for repeats in in_series(own).values()],
                "pictures": [{"name": name, "what": what} for name, (what, _) in drawn.items()],
            }
        )
    text = json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False)
    (directory / "tradeoff.json").write_text(text + "\n", encoding="utf-8")
    # the csv writer ends its lines itself
    with (directory / "tradeoff.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    # lost lines are not compared with the noise: alone, they leave nothing to plot
    if study is not None and any(worth.noises is not None for worth in study.effects):
        with mpl.rc_context(STYLE):
            drawings["effects"] = save_drawing(_effects(study), directory, "effects")
    page = directory / "index.html"
    text = fill_template("tradeoff.html.j2", facts | {"movies": movies, "shown_ms": SHOWN_MS}, drawings)
    page.write_text(text, encoding="utf-8")
    return page


def _draw(
    runs: Sequence[TradeoffRun], shown: TradeoffRun, truth: NDArray[Any] | None, prefix: str
) -> dict[str, tuple[str, Figure]]:
    """Draw the figures of one case and voxel size: name → description and figure."""
    plots: list[tuple[Metric, str, str, Clock]] = [
        (metric, metric.name, "wall time", "seconds") for metric in METRICS if known(runs, metric)
    ]
    if plots:
        plots.insert(1, (plots[0][0], "processor", "processor time", "processor_s"))
    drawn = {
        f"{prefix}-{name}": (f"{metric.label} over {time}", curves(runs, metric, clock))
        for metric, name, time, clock in plots
    }
    what = f"one frame after more and more time: {shown.solver}, {shown.preset}"
    return drawn | {f"{prefix}-frames": (what, frames(shown, truth))}


def _movie(run: TradeoffRun, truth: NDArray[Any] | None) -> dict[str, Any]:
    """Draw every result of a run, next to the truth if it is known, for the page's player."""
    peak = white(run, truth)
    pictures = [
        beside([each.frame] if truth is None else [each.frame, truth], peak)
        for each in run.points
        if each.frame is not None
    ]
    clip = clip_of(pictures)
    # A clip leaves out pictures until it fits into the page, and with them their labels.
    labels = [in_caption(each) for each in run.points if each.frame is not None]
    return {"frames": clip.frames, "labels": labels[:: clip.step], "beside": truth is not None}


def _still_sentence(runs: Sequence[TradeoffRun]) -> list[str]:
    """Compare the runs with the best possible still."""
    mean_db = yardstick(runs)
    if mean_db is None:
        return []
    reached = max(run.end.psnr_db or 0.0 for run in runs)
    than = (
        "more than any of these runs" if mean_db > reached else f"the best of these runs has {reached:.0f} dB"
    )
    return [f"The truth's mean over time, shown as a still, has {mean_db:.0f} dB; {than}."]


def _end(repeats: Sequence[TradeoffRun]) -> dict[str, Any]:
    """Summarise where the repeats of a series ended: median, lowest and highest value of each quantity."""
    first = repeats[0]
    found: dict[str, Any] = {
        "solver": first.solver,
        "preset": first.preset,
        "dtype": first.dtype,
        "repeats": len(repeats),
        "cut": sum(run.cut for run in repeats),
        "iterations": round(median(run.end.iterations for run in repeats)),
    }
    for name in QUANTITIES:
        values = [value for run in repeats if (value := getattr(run.end, name)) is not None]
        found[name] = {"median": median(values), "low": min(values), "high": max(values)} if values else None
    return found


def _effects(study: Study) -> Figure:
    """Plot the change of the lines without each effect of the simulator against the effect's cost."""
    figure = canvas(3.4)
    ax = figure.subplots()
    known = [worth for worth in study.effects if worth.noises is not None]
    # logarithmic axes have no 0
    costs = [max(worth.us_per_line, 1e-3) for worth in known]
    sizes = [max(worth.noises or 0.0, 1e-4) for worth in known]
    ax.plot(costs, sizes, "o", color=SOLVER_COLOURS[0], ms=7)
    for worth, cost, size in zip(known, costs, sizes, strict=True):
        label = worth.effect.replace("_", " ")
        ax.annotate(label, (cost, size), textcoords="offset points", xytext=(7, 4), fontsize=8.5)
    # The grey band: below 0.05 of the noise an effect can be left out, as `acquire simulate` says.
    ax.axhspan(ax.get_ylim()[0] if min(sizes) > 0.05 else min(sizes) / 3, 0.05, color=GRID, zorder=0, lw=0)
    ax.set(
        xscale="log",
        yscale="log",
        xlabel="cost (µs per line and arm)",
        ylabel="error of the lines without it\n(relative to their noise)",
        # More room on the right, where the effects' names are.
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
