"""All figures of the paper on one page in a single file, and its numbers as JSON."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, get_args

import matplotlib as mpl

from acquire.evaluate.animation import FRAME_DURATION_MS, write_webp
from acquire.evaluate.page import fill_template
from acquire.evaluate.paper.comparison import Verdict
from acquire.evaluate.paper.studio import PaperFigure, Studio
from acquire.evaluate.player import Clip, beside, clip_of
from acquire.evaluate.summary import rounded
from acquire.evaluate.themed import STYLE, save_drawing

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime
    from pathlib import Path

    from acquire.evaluate.host import Busyness
    from acquire.evaluate.themed import Drawing

MOVIE_PX = 256


@dataclass(frozen=True, slots=True)
class Drawn:
    """A figure prepared for the page: its facts as in ``summary.json``, its drawings and its clip."""

    facts: dict[str, Any]
    drawings: dict[str, Drawing]
    clip: Clip
    labels: list[str]


def draw(figure: PaperFigure, directory: Path, host: Busyness) -> Drawn:
    """Write the pictures and the animation of a figure; ``host`` is the load of the machine."""
    with mpl.rc_context(STYLE):
        drawings = {
            each.name: save_drawing(
                each.drawing,
                directory,
                f"{figure.name}-{each.name}",
                narrow=each.narrow,
                narrow_in=each.narrow_in,
            )
            for each in figure.pictures
        }
    clip, labels = Clip([], 1, 0), []
    if figure.movie:
        panels = list(zip(*figure.movie.values(), strict=True))
        enlarged = [beside(each, 1.0, MOVIE_PX) for each in panels]
        write_webp(directory / f"{figure.name}.webp", enlarged)
        # in their own size: the page enlarges them, and stays small
        clip = clip_of([beside(each, 1.0) for each in panels])
        labels = [f"{frame * figure.movie_ms:.2f} ms" for frame in range(0, len(panels), clip.step)]
    facts = {
        "name": figure.name,
        "title": figure.title,
        "text": figure.text,
        "rows": [asdict(row) for row in figure.rows],
        "seconds": {what: rounded(seconds, 2) for what, seconds in figure.seconds.items()},
        "host": host.facts(),
        "numbers": {what: rounded(value, 4) for what, value in figure.numbers.items()},
        "pictures": [{"name": each.name, "caption": each.caption} for each in figure.pictures],
        "movie": f"{figure.name}.webp" if figure.movie else None,
        "panels": list(figure.movie),
        "slowed_down": round(FRAME_DURATION_MS / (clip.step * figure.movie_ms)),
    }
    named = {f"{figure.name}-{name}": each for name, each in drawings.items()}
    return Drawn(facts, named, clip, labels)


def write_page(
    figures: Sequence[Drawn],
    studio: Studio,
    command: str,
    when: datetime,
    recording: str | None = None,
    missing: Sequence[str] = (),
) -> Path:
    """Write ``index.html`` and ``summary.json`` of the drawn figures into the studio's directory.

    ``missing`` are the figures still to be made: a page that says so remains if they never are.
    """
    found = Counter(row["verdict"] for each in figures for row in each.facts["rows"])
    facts = {
        "when": when.isoformat(timespec="seconds"),
        "command": command,
        "seed": None if recording is not None else studio.seed,
        "recording": recording,
        "solver": studio.options.solver,
        "preset": studio.options.preset,
        "budget_s": studio.options.budget_s,
        # Also those that no row has: summary.json has the same keys for every choice of figures.
        "verdicts": {verdict: found[verdict] for verdict in get_args(Verdict)},
        "figures": [each.facts for each in figures],
        "missing": list(missing),
    }
    text = json.dumps(facts, indent=2, allow_nan=False, ensure_ascii=False)
    (studio.directory / "summary.json").write_text(text + "\n", encoding="utf-8")
    movies = {each.facts["name"]: each for each in figures if each.clip.frames}
    drawings = {name: drawing for each in figures for name, drawing in each.drawings.items()}
    page = studio.directory / "index.html"
    shown = {"movies": movies, "shown_ms": FRAME_DURATION_MS}
    page.write_text(fill_template("paper.html.j2", facts | shown, drawings), encoding="utf-8")
    return page
