"""Videos and recordings in napari: ``napari --plugin tdi-acquire NAME.zarr``.

``napari.toml`` next to this file is the manifest that napari finds through its entry point. Nothing here
imports napari: a reader returns plain tuples of data, options and layer type.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import AcquireError
from acquire.exchange.lazy import PAGE_LINES, Stack, frames, pages
from acquire.lines import ARMS
from acquire.store import format_of, open_recording, open_video

if TYPE_CHECKING:
    from collections.abc import Callable


Layer = tuple[Any, dict[str, Any], str]
SAMPLED = 5
"""Number of pages that are sampled to find the black and white levels."""
GAP = 8
"""Pixels between the arms, which are shown side by side."""


def reader_for(path: str | list[str]) -> Callable[[Any], list[Layer]] | None:
    """Return the reader for a path; None if it is neither a recording nor a video of ours."""
    # A list of paths is a stack of files to napari.
    if not isinstance(path, str):
        return None
    try:
        kind = format_of(path) or ""
    # Not an error: napari asks every reader about every path.
    except AcquireError:
        return None
    if kind.startswith("acquire-video/"):
        return read_video
    return read_recording if kind.startswith("acquire-recording/") else None


def read_video(path: Any) -> list[Layer]:
    """Return the trusted frames as one image; all frames if none is trusted, which its name then states."""
    file = open_video(str(path))
    trusted = file.trusted
    kept = trusted or range(len(file.time_ns))
    reason = "not known which frames are trusted" if trusted is None else "no frame is trusted"
    name = f"{_name(path)} ({f'frames {kept.start} to {kept.stop - 1}' if trusted else reason})"
    step, origin = file.scale, file.origin
    # older videos have no channel, and no window of black and white in it
    channels = file.attrs["ome"].get("omero", {}).get("channels", ())
    windows = [(float(each["window"]["start"]), float(each["window"]["end"])) for each in channels]
    options = {
        "name": name,
        "scale": list(step),
        "translate": [origin[0] + step[0] * kept.start, *origin[1:]],
        "contrast_limits": windows[0] if windows else _limits(frames(file, range(len(file.time_ns)))),
        "multiscale": False,
        "rgb": False,
        "metadata": {
            "provenance": file.attrs.get("provenance"),
            "time_ns": file.time_ns[kept.start : kept.stop],
        },
    }
    return [(frames(file, kept), options, "image")]


def read_recording(path: Any) -> list[Layer]:
    """Return the lines of both arms side by side, in pages for the slider, and an overview if there is one.

    The overview is hidden at first; it shows the whole recording at once.
    """
    recording = open_recording(str(path))
    arms: list[Layer] = []
    overviews: list[Layer] = []
    for number, arm in enumerate(ARMS):
        stack = pages(recording, arm)
        # `rgb` and `multiscale` are stated, since napari would guess them from the shape.
        shown = {"contrast_limits": _limits(stack), "multiscale": False, "rgb": False}
        column = number * (stack.shape[2] + GAP)
        options = {
            **shown,
            "name": f"{_name(recording)}, arm {arm}",
            "translate": [0, 0, column],
            "metadata": {
                "first_line": recording.first_line,
                "lines_of_a_page": PAGE_LINES,
                **recording.info(),
            },
        }
        arms.append((stack, options, "image"))
        if (found := recording.overview(arm)) is not None:
            options = {
                **shown,
                "name": f"{_name(recording)}, arm {arm}, overview ({found.lines_per_row} lines a row)",
                # Without the axis of the pages, which the overview does not have.
                "translate": [0, column],
                "visible": False,
                "metadata": {"first_line": found.first_line, "lines_per_row": found.lines_per_row},
            }
            overviews.append((found.rows, options, "image"))
    # napari draws later layers over earlier ones.
    return [*overviews, *arms]


def _name(path: object) -> str:
    return str(path).rstrip("/").rpartition("/")[2].removesuffix(".zarr")


def _limits(stack: Stack) -> tuple[float, float]:
    chosen = np.unique(np.linspace(0, len(stack) - 1, SAMPLED).astype(int))
    values = np.stack([stack.picture(int(number)) for number in chosen])
    low, high = (float(each) for each in np.quantile(values, (0.001, 0.999)))
    return low, high if high > low else low + 1.0
