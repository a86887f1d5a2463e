"""The report of a demonstration run: one HTML page that holds everything, and its pictures beside it.

The page is rendered from :meth:`DemoResult.summary` alone, which is also written as ``summary.json``, so
that page, file and command line state the same numbers. Pictures and style are inside the page: it can
be sent to somebody as one file and refers to nothing outside.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from acquire.errors import UsageError
from acquire.evaluate import animation
from acquire.evaluate.page import fill_template, webp_uri
from acquire.evaluate.result import (
    ArmLedger,
    CaptureFacts,
    DemoResult,
    Region,
    RigFacts,
    SolverResult,
    Stage,
    evaluate_solver,
)
from acquire.evaluate.summary import summarise

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.evaluate.themed import Drawing

__all__ = [
    "ArmLedger",
    "CaptureFacts",
    "DemoResult",
    "Region",
    "RigFacts",
    "SolverResult",
    "Stage",
    "evaluate_solver",
    "render_page",
    "write_report",
]

PAGE = "index.html"
SUMMARY = "summary.json"
ANIMATION = "animation.webp"


def write_report(result: DemoResult, directory: Path) -> Path:
    """Write page, summary, figures and animation into ``directory`` (made if absent); returns the page.

    Files of an earlier report there are replaced. Raises UsageError when the directory cannot be made.
    """
    from acquire.evaluate import figures  # matplotlib costs more than everything else here together

    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"the report cannot be written to {directory}: {error.strerror}") from error
    drawings = figures.save_figures(result, directory)
    movie = directory / ANIMATION
    step = animation.save_animation(result, movie)
    summary = summarise(result) | {"animation": _animation_facts(result, step)}
    (directory / SUMMARY).write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    page = directory / PAGE
    page.write_text(render_page(summary, drawings, movie), encoding="utf-8")
    return page


def render_page(summary: dict[str, Any], drawings: dict[str, Drawing], movie: Path) -> str:
    """The page as text: ``summary``, the drawings and the frames of the animation, which it takes in."""
    frames = {
        "animation_frames": [webp_uri(each) for each in animation.stills(movie)],
        "frame_shown_ms": animation.FRAME_DURATION_MS,
    }
    return fill_template("report.html.j2", summary | frames, drawings)


def _animation_facts(result: DemoResult, step: int) -> dict[str, Any]:
    shown_ms = step * result.frame_interval_us / 1e3
    return {
        "file": ANIMATION,
        "every": step,
        "frames": len(range(0, len(result.frame_ms), step)),
        "slowed_down": round(animation.FRAME_DURATION_MS / shown_ms),
    }
