"""The trade-off on one page: what time buys, in words, curves and frames, and the table."""

from __future__ import annotations

import csv
import json
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any

import matplotlib as mpl

from acquire.evaluate.figures import DPI, SOLVER_COLOURS, STYLE
from acquire.evaluate.knees import sentences
from acquire.evaluate.paper.drawing import canvas
from acquire.evaluate.report import fill_template
from acquire.evaluate.tradeoff import table
from acquire.evaluate.tradeoff_figures import METRICS, THEMES, curves, frames, in_series, known, yardstick

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from datetime import datetime
    from pathlib import Path

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.tradeoff import Run
    from acquire.evaluate.tradeoff_figures import Theme
    from acquire.recon.segments import Voxels
    from acquire.simulate import Study

    Truths = Mapping[tuple[str, Voxels], NDArray[Any] | None]

QUANTITIES = ("seconds", "processor_s", "psnr_db", "ssim", "amplitude_error", "frequency_error_hz")


def write_page(
    runs: Sequence[Run],
    truths: Truths,
    study: Study | None,
    directory: Path,
    heading: dict[str, Any],
    when: datetime,
) -> Path:
    """Write ``index.html``, ``tradeoff.csv``, ``tradeoff.json`` and the pictures into ``directory``.

    ``truths`` are the true frames beside those that runs show; ``heading`` has ``title``, ``command`` and
    ``notes``, sentences about all of it.
    """
    rows = table(runs)
    facts: dict[str, Any] = {
        **heading,
        "when": when.isoformat(timespec="seconds"),
        "rows": rows,
        "study": _study_facts(study),
        "sections": [],
    }
    pictures: dict[str, Path] = {}
    for number, (case, voxels) in enumerate(dict.fromkeys((run.case, run.voxels) for run in runs)):
        own = [run for run in runs if (run.case, run.voxels) == (case, voxels)]
        drawn = _draw(own, truths.get((case, voxels)), directory, f"case-{number}", pictures)
        facts["sections"].append(
            {
                "case": case,
                "voxels": str(voxels),
                "sentences": [
                    *(text for repeats in in_series(own).values() for text in sentences(repeats)),
                    *_beside_a_still(own),
                ],
                "ends": [_end(repeats) for repeats in in_series(own).values()],
                "pictures": drawn,
            }
        )
    text = json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False)
    (directory / "tradeoff.json").write_text(text + "\n", encoding="utf-8")
    with (directory / "tradeoff.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    if study is not None and study.effects:
        pictures["effects"] = directory / "effects.png"
        with mpl.rc_context(STYLE):
            _effects(study).savefig(pictures["effects"], dpi=DPI)
    page = directory / "index.html"
    page.write_text(fill_template("tradeoff.html.j2", facts, pictures), encoding="utf-8")
    return page


def _draw(
    runs: Sequence[Run],
    truth: NDArray[Any] | None,
    directory: Path,
    prefix: str,
    pictures: dict[str, Path],
) -> list[dict[str, str]]:
    """Pictures of one case in one kind of voxels, in light and dark; their names and what they show."""
    best = max((run for run in runs if run.repeat == 0), key=lambda run: run.end.psnr_db or 0.0)
    metrics = [metric for metric in METRICS if known(runs, metric)]
    made: list[dict[str, str]] = []

    def save(name: str, what: str, draw: Callable[[Theme], Figure]) -> None:
        made.append({"name": f"{prefix}-{name}", "what": what})
        for suffix, theme in THEMES.items():
            place = pictures[f"{prefix}-{name}{suffix}"] = directory / f"{prefix}-{name}{suffix}.png"
            draw(theme).savefig(place, dpi=DPI)

    for metric in metrics[:1]:
        save(metric.name, f"{metric.label} over wall time", partial(curves, runs, metric, "seconds"))
    save("frames", f"one frame on the way: {best.solver}, {best.preset}", partial(frames, best, truth))
    for metric in metrics[:1]:
        save("processor", f"{metric.label} over processor time", partial(curves, runs, metric, "processor_s"))
    for metric in metrics[1:]:
        save(metric.name, f"{metric.label} over wall time", partial(curves, runs, metric, "seconds"))
    return made


def _beside_a_still(runs: Sequence[Run]) -> list[str]:
    """How the runs stand to the best still that there could be."""
    mean_db = yardstick(runs)
    if mean_db is None:
        return []
    reached = max(run.end.psnr_db or 0.0 for run in runs)
    than = (
        "more than any of these reached" if mean_db > reached else f"the best of these reached {reached:.0f}"
    )
    return [f"The truth's own time mean, shown as a still, has {mean_db:.0f} dB: {than}."]


def _end(repeats: Sequence[Run]) -> dict[str, Any]:
    """Where the repeats of a series ended: the median of each quantity, and lowest and highest."""
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
