"""Reconstructed videos on one page: a player, the residual over time, and the facts of each sub-segment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np

from acquire.evaluate.error_map import draw_error
from acquire.evaluate.page import fill_template
from acquire.evaluate.player import beside, clip_of
from acquire.evaluate.themed import GRID, SOLVER_COLOURS, STYLE, Drawing, canvas, drawing_of
from acquire.showing import error_in_words
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.evaluate.rendering import Appearance, Panel
    from acquire.store import VideoFile

MOST_PARTS, MOST_POINTS = 100, 1500
"""Largest number of sub-segments and of points of a curve on a page; a video may have any number."""
KNOWN = ("recording", "first_line", "lines", "solver", "preset", "seconds")
LEAST_PERCENT, MOST_PERCENT = 5.0, 100.0
"""Limits for the top of the residual axis, so that neither noise nor lines in the dark dominate the plot."""
NARROW_IN = 2.2


def write_page(
    panels: Sequence[Panel],
    peaks: Sequence[float],
    times: NDArray[np.int64],
    *,
    path: Path,
    look: Appearance,
    progress: Callable[[int, int], object] | None = None,
) -> int:
    """Write a page with the videos side by side at ``times`` (UTC, ns); return the frames in its player.

    Pixels are shown in their original size, at most ``look.panel_px`` from top to bottom.
    """
    height = min(look.panel_px, max(panel.file.video.shape[1] for panel in panels))
    pictures = []
    for number, time_ns in enumerate(times.tolist()):
        # each video has its own white
        frames = [panel.at(time_ns) / peak for panel, peak in zip(panels, peaks, strict=True)]
        pictures.append(beside(frames, 1.0, height))
        if progress is not None:
            progress(number + 1, len(times))
    clip = clip_of(pictures)
    shown = times[:: clip.step]
    steps_ms = np.diff(shown) / 1e6
    facts = {
        "names": [panel.name for panel in panels],
        "clip": clip,
        "labels": [_label(panels, int(time_ns), int(times[0])) for time_ns in shown],
        "shown_ms": round(1000 / look.fps),
        "slowed_down": round(1000 / look.fps / float(np.median(steps_ms))) if len(steps_ms) else 1,
        "begin": np.datetime_as_string(times[0].astype("datetime64[ns]"), "s"),
        "videos": [_account(panel) for panel in panels],
    }
    drawn = {f"misfit-{number}": _misfit(panel.file) for number, panel in enumerate(panels)}
    drawn |= {f"error-{number}": draw_error(panel.file) for number, panel in enumerate(panels)}
    drawings = {name: drawing for name, drawing in drawn.items() if drawing is not None}
    path.write_text(fill_template("video.html.j2", facts, drawings), encoding="utf-8")
    return len(clip.frames)


def _label(panels: Sequence[Panel], time_ns: int, start_ns: int) -> str:
    """Return the time of the frames, and the videos whose frame is not trusted."""
    untrusted = [
        panel.name
        for panel in panels
        if panel.file.trusted is not None and panel.index(time_ns) not in panel.file.trusted
    ]
    at = f"{(time_ns - start_ns) / 1e6:.3f} ms"
    return f"{at} · not trusted: {', '.join(untrusted)}" if untrusted else at


def _account(panel: Panel) -> dict[str, Any]:
    """Return the facts of one video, from its arrays and its provenance."""
    file, known = panel.file, panel.file.attrs.get("provenance") or {}
    count, rows, columns = file.video.shape
    parts = known.get("segments", [])
    of_parts = [text for part in parts for text in part["warnings"]]  # older videos have only these
    return {
        "name": panel.name,
        "size": f"{counted(count, 'frame')} of {rows} × {columns}, {file.interval_ns / 1e3:.6g} µs each",
        "trusted": None if file.trusted is None else [file.trusted.start, file.trusted.stop - 1],
        "known": {key: known.get(key) for key in KNOWN},
        "error": error_in_words(known["error"]) if known.get("error") else None,
        "calibration": (known.get("calibration") or {}).get("corrected"),
        "parts": [
            {
                "name": part["name"] or str(number),
                "lines": f"{part['first_line']} … {part['first_line'] + part['lines'] - 1}",
                "voxels": f"{part['spatial_merge']} × {part['temporal_merge']}",
                "iterations": part["iterations"],
                "seconds": part["seconds"],
                "processor_s": part.get("processor_s"),
                "misfit_percent": _percent(part["quality"]["misfit"]),
                "prediction_percent": _percent(part["quality"]["prediction"]),
                "trusted": part["trusted"],
            }
            for number, part in enumerate(parts[:MOST_PARTS], 1)
        ],
        "more_parts": max(0, len(parts) - MOST_PARTS),
        "warnings": known.get("warnings", list(dict.fromkeys(of_parts)))[:MOST_PARTS],
    }


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


def _misfit(file: VideoFile) -> Drawing | None:
    """Plot the relative residual of the lines of each frame; grey where frames are not trusted."""
    if file.quality is None or not np.isfinite(file.quality).any():
        return None
    width = -(-len(file.quality) // MOST_POINTS)
    padded = np.pad(file.quality.astype(np.float64), (0, -len(file.quality) % width), constant_values=np.nan)
    # fmax leaves out NaN, which is in the padding and where a frame has no residual.
    worst = np.fmax.reduce(padded.reshape(-1, width), axis=1)  # the worst of the frames that share a point
    times_ms = (file.time_ns[::width] - file.time_ns[0]) / 1e6
    end_ms = times_ms[-1] + width * file.interval_ns / 1e6
    with mpl.rc_context(STYLE):
        figure = canvas(2.4)
        ax = figure.subplots()
        if file.trusted is not None:
            first, stop = (edge * file.interval_ns / 1e6 for edge in (file.trusted.start, file.trusted.stop))
            for low, high in ((0.0, first), (stop, end_ms)):
                ax.axvspan(low, high, color=GRID, lw=0)
        top = np.clip(1.1 * 100 * np.nanmax(worst), LEAST_PERCENT, MOST_PERCENT)
        ax.step(times_ms, 100 * worst, where="post", color=SOLVER_COLOURS[0], lw=1.1)
        ax.set(xlim=(0, end_ms), ylim=(0, top), xlabel="time (ms)", ylabel="residual (%)")
        return drawing_of(figure, narrow_in=NARROW_IN)
