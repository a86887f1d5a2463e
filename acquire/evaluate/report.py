"""The report of a demo run: one HTML page with everything in it, and its pictures in the same directory.

The page is rendered from :func:`summarise` alone, which is also written as ``summary.json``, so that page,
file and command line state the same numbers. Pictures and style are embedded in the page, so it can be sent
as a single file.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from acquire.errors import UsageError
from acquire.evaluate import animation
from acquire.evaluate.page import fill_template, webp_uri
from acquire.evaluate.result import (
    ArmAccount,
    CaptureFacts,
    DemoResult,
    Region,
    RigFacts,
    SolverResult,
    TimedStep,
    evaluate_solver,
)
from acquire.evaluate.summary import summarise

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.evaluate.themed import Drawing

__all__ = [
    "ArmAccount",
    "CaptureFacts",
    "DemoResult",
    "Region",
    "RigFacts",
    "SolverResult",
    "TimedStep",
    "evaluate_solver",
    "render_page",
    "write_report",
]

PAGE = "index.html"
SUMMARY = "summary.json"
ANIMATION = "animation.webp"


def write_report(result: DemoResult, directory: Path) -> Path:
    """Write page, summary, figures and animation into ``directory`` (created if needed); return the page.

    Files of an earlier report are replaced. Raises UsageError if the directory cannot be created.
    """
    from acquire.evaluate import figures  # importing matplotlib takes longer than everything else here

    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"the report cannot be written to {directory}: {error.strerror}") from error
    drawings = figures.save_figures(result, directory)
    movie = directory / ANIMATION
    step = animation.save_animation(result, movie)
    shown_ms = step * result.frame_interval_us / 1e3
    facts = {
        "file": ANIMATION,
        "every": step,
        "frames": len(range(0, len(result.frame_ms), step)),
        "slowed_down": round(animation.FRAME_DURATION_MS / shown_ms),
    }
    summary = summarise(result) | {"animation": facts}
    # JSON has no NaN: `summarise` gives None in its place, and anything else is refused here.
    (directory / SUMMARY).write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    page = directory / PAGE
    page.write_text(render_page(summary, drawings, movie), encoding="utf-8")
    return page


def render_page(summary: dict[str, Any], drawings: dict[str, Drawing], movie: Path) -> str:
    """Return the page as text, with the summary, the drawings and the frames of the animation embedded."""
    frames = {
        "animation_frames": [webp_uri(each) for each in animation.stills(movie)],
        "frame_shown_ms": animation.FRAME_DURATION_MS,
    }
    return fill_template("report.html.j2", summary | frames, drawings)
