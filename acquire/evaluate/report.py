"""The report of a demonstration run: one HTML page that holds everything, and its pictures beside it.

The page is rendered from :meth:`DemoResult.summary` alone, which is also written as ``summary.json``, so
that page, file and command line state the same numbers. Pictures and style are inside the page: it can
be sent to somebody as one file and refers to nothing outside.
"""

from __future__ import annotations

import base64
import json
import os
from typing import TYPE_CHECKING, Any

import jinja2

from acquire.cores import usable_cores
from acquire.errors import UsageError
from acquire.evaluate import animation
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
MEDIA_TYPES = {".png": "image/png", ".svg": "image/svg+xml", ".webp": "image/webp"}
NARROW_SPACE = "\N{NARROW NO-BREAK SPACE}"
MINUS = "\N{MINUS SIGN}"


def write_report(result: DemoResult, directory: Path) -> Path:
    """Write page, summary, figures and animation into ``directory`` (made if absent); returns the page.

    Files of an earlier report there are replaced. Raises UsageError when the directory cannot be made.
    """
    from acquire.evaluate import figures  # matplotlib costs more than everything else here together

    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"report directory {directory}: {error.strerror}") from error
    pictures = figures.save_figures(result, directory)
    pictures["animation"] = directory / ANIMATION
    step = animation.save_animation(result, pictures["animation"])
    summary = summarise(result)
    summary["animation"] = _animation_facts(result, step)
    summary["host"] = {"cores": usable_cores(), "load": round(os.getloadavg()[0], 1)}
    (directory / SUMMARY).write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    page = directory / PAGE
    page.write_text(render_page(summary, pictures), encoding="utf-8")
    return page


def render_page(summary: dict[str, Any], pictures: dict[str, Path]) -> str:
    """The page as text: ``summary`` and the pictures (name -> PNG or WebP file), which it takes in."""
    stills = {name: path for name, path in pictures.items() if name != "animation"}
    frames = {
        "animation_frames": [picture_uri(each) for each in animation.stills(pictures["animation"])],
        "frame_shown_ms": animation.FRAME_DURATION_MS,
    }
    return fill_template("report.html.j2", summary | frames, stills)


def fill_template(template: str, facts: dict[str, Any], pictures: dict[str, Path]) -> str:
    """A page out of a template of ours; the pictures become ``images`` by the same names, inside the page."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("acquire.evaluate"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"num": number, "hz": hertz}
    images = {name: data_uri(path) for name, path in pictures.items()}
    return environment.get_template(template).render(**facts, images=images)


def data_uri(path: Path) -> str:
    """The file as a ``data:`` URI; its suffix tells the media type."""
    content = base64.b64encode(path.read_bytes()).decode("ascii")
    return f"data:{MEDIA_TYPES[path.suffix]};base64,{content}"


def picture_uri(webp: bytes) -> str:
    """A WebP picture as a ``data:`` URI."""
    return f"data:{MEDIA_TYPES['.webp']};base64,{base64.b64encode(webp).decode('ascii')}"


def number(value: float | None, digits: int | None = None, *, signed: bool = False) -> str:
    """A number as the page shows it: thousands apart, a true minus sign, an en dash for None.

    Without ``digits`` a float shows as many as it has, none for a whole one.
    """
    if value is None:
        return "–"
    text = f"{value:{'+' if signed and value else ''},{'' if digits is None else f'.{digits}f'}}"
    if digits is None:
        text = text.removesuffix(".0")
    return text.replace(",", NARROW_SPACE).replace("-", MINUS)


def hertz(value: float | None) -> str:
    """A frequency that somebody set: ``5 kHz``, ``30 Hz``, or ``constant``."""
    if value is None:
        return "constant"
    return f"{value / 1e3:g}{NARROW_SPACE}kHz" if value >= 1e3 else f"{value:g}{NARROW_SPACE}Hz"


def _animation_facts(result: DemoResult, step: int) -> dict[str, Any]:
    shown_ms = step * result.frame_interval_us / 1e3
    return {
        "file": ANIMATION,
        "every": step,
        "frames": len(range(0, len(result.frame_ms), step)),
        "slowed_down": round(animation.FRAME_DURATION_MS / shown_ms),
    }
