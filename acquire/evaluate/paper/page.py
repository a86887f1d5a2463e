"""All figures of the paper in one page that refers to nothing outside, and its numbers as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import matplotlib as mpl

from acquire.evaluate.animation import FRAME_DURATION_MS, write_webp
from acquire.evaluate.figures import DPI, STYLE
from acquire.evaluate.paper.studio import PaperFigure, Studio
from acquire.evaluate.rendering import grey
from acquire.evaluate.report import fill_template
from acquire.evaluate.summary import rounded

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime
    from pathlib import Path

MOVIE_PX = 256


def draw(figure: PaperFigure, directory: Path) -> dict[str, Path]:
    """Write the pictures and the animation of a figure; file name → path."""
    paths = {}
    with mpl.rc_context(STYLE):
        for picture in figure.pictures:
            name = f"{figure.name}-{picture.name}.png"
            paths[name] = directory / name
            picture.drawing.savefig(paths[name], dpi=DPI)
    if figure.movie is not None:
        name = f"{figure.name}.webp"
        paths[name] = directory / name
        write_webp(paths[name], [grey(frame, 1.0, MOVIE_PX).convert("RGB") for frame in figure.movie])
    return paths


def summarise(figure: PaperFigure) -> dict[str, Any]:
    """What the page and ``summary.json`` say of a figure."""
    return {
        "name": figure.name,
        "title": figure.title,
        "text": figure.text,
        "rows": [asdict(row) for row in figure.rows],
        "seconds": {what: rounded(seconds, 2) for what, seconds in figure.seconds.items()},
        "numbers": {what: rounded(value, 4) for what, value in figure.numbers.items()},
        "pictures": [
            {"file": f"{figure.name}-{each.name}.png", "caption": each.caption} for each in figure.pictures
        ],
        "movie": f"{figure.name}.webp" if figure.movie is not None else None,
        "slowed_down": round(FRAME_DURATION_MS / figure.movie_ms),
    }


def write_page(
    figures: Sequence[dict[str, Any]],
    pictures: dict[str, Path],
    studio: Studio,
    command: str,
    when: datetime,
    recording: str | None = None,
) -> Path:
    """Write ``index.html`` and ``summary.json`` of summarised figures into the studio's directory."""
    facts = {
        "when": when.isoformat(timespec="seconds"),
        "command": command,
        "seed": None if recording is not None else studio.seed,
        "recording": recording,
        "solver": studio.options.solver,
        "preset": studio.options.preset,
        "budget_s": studio.options.budget_s,
        "figures": list(figures),
    }
    text = json.dumps(facts, indent=2, allow_nan=False, ensure_ascii=False)
    (studio.directory / "summary.json").write_text(text + "\n", encoding="utf-8")
    page = studio.directory / "index.html"
    page.write_text(fill_template("paper.html.j2", facts, pictures), encoding="utf-8")
    return page
