"""One choice of prior, weight and band for all tiles behind a fibre, or for the sub-segments of a stretch.

The search for them is most of what a tile takes. It is made on the tile where most changes, by its lines
alone, and handed to the others, which keep it where it predicts their own held-out samples as closely
(`acquire.recon.handed`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.recon.segments import Voxels
from acquire.reconstruct.work import as_read

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.fibre import Tile
    from acquire.lines import Segment
    from acquire.recon.handed import Choice
    from acquire.reconstruct.select import VideoRequest
    from acquire.reconstruct.work import Options, Part, Task
    from acquire.store import Recording

MOST_LINES = 4
"""Of a tile that are looked at, in n."""
SPARE_LINES = 1.25
"""Lines beside the unknowns of a scene at rest, below which these explain too much of what moves."""
MOVES = 0.05
"""Of the noise, by which what a scene at rest leaves must exceed it: less is rounding."""


class Handing:
    """Remembers the first choice in each kind of voxels; ``wanted``: else nothing is handed on."""

    def __init__(self, wanted: bool) -> None:
        self._wanted = wanted
        self._choices: dict[Voxels, Choice | None] = {}
        self._searched: set[Voxels] = set()

    def awaits(self, task: Task) -> bool:
        """Whether the choice that is meant for a task is being made."""
        return self._wanted and task.segment.voxels in self._searched - self._choices.keys()

    def told(self, task: Task) -> Task:
        """The task with what is handed to it; the first of its kind searches."""
        if not self._wanted:
            return task
        self._searched.add(task.segment.voxels)
        return replace(task, choice=self._choices.get(task.segment.voxels))

    def found(self, task: Task, part: Part) -> None:
        """What the first of a kind chose; None where nothing can be handed on, and all search."""
        self._choices.setdefault(task.segment.voxels, part.choice)


def handed_on(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Tiles, or numbers of sub-segments, that searched, and that kept or changed what was handed on: JSON."""
    told: dict[str, list[str]] = {"searched": [], "kept": [], "changed": []}
    for number, part in enumerate(parts, 1):
        kept = part["kept_choice"]
        how = "searched" if kept is None else "kept" if kept else "changed"
        told[how].append(part["tile"] or str(number))
    return {how: list(dict.fromkeys(names)) for how, names in told.items()}


def liveliest_first(recording: Recording, request: VideoRequest, options: Options) -> tuple[Tile, ...]:
    """The tiles of a request, that one first whose lines show most change; of a still, most contrast.

    A tile at rest is seen as a convolution of each pixel's profile with the code, which its lines determine
    where they are more than n + S − 1: what that leaves beyond the noise is what changes.
    """
    segments = request.sub_segments()
    middle = segments[len(segments) // 2]
    most = min(middle.lines, MOST_LINES * request.grid.size)
    first = middle.first_line + (middle.lines - most) // 2
    seen = [energies(as_read(recording.cut(first, most, tile), options)) for tile in request.tiles]
    contrast, change = (np.array(each) for each in zip(*seen, strict=True))
    moving = request.grid.voxels.temporal_merge < middle.lines * request.stream.substeps
    lively = change if moving and (change > 0).any() else contrast
    best = int(np.argmax(lively))
    return (request.tiles[best], *(tile for tile in request.tiles if tile != request.tiles[best]))


def energies(segment: Segment) -> tuple[float, float]:
    """Mean square of a segment's lines about their mean, and of what no scene at rest explains of them, both
    without the noise; 0 where there is no more than that, or where lines are too few."""
    geometry, samples = segment.geometry, segment.samples(np.float64)
    variance = segment.variance()
    unknowns = geometry.size + geometry.substeps - 1
    contrast, left, noise = 0.0, 0.0, 0.0
    design = _windows(segment.code, geometry.substeps, geometry.lines, unknowns)
    for arm, (lines, mask) in enumerate(zip(samples, segment.mask, strict=True)):
        pixels = mask.mean(axis=0) > 0.5  # columns that see nothing are masked throughout
        rows = mask[:, pixels].all(axis=1)
        good = lines[np.ix_(rows, pixels)]
        if not good.size:
            continue
        contrast += float(good.var(axis=0).mean())
        if variance is not None:
            noise += float(variance[arm][np.ix_(rows, pixels)].mean())
        if len(good) > SPARE_LINES * unknowns:
            fitted, *_ = np.linalg.lstsq(design[rows], good, rcond=None)
            off = good - design[rows] @ fitted
            left += float(np.square(off).sum() / ((len(good) - unknowns) * good.shape[1]))
    change = left - noise
    return max(0.0, contrast - noise), change if change > MOVES * noise else 0.0


def _windows(code: NDArray[Any], substeps: int, lines: int, length: int) -> NDArray[np.float64]:
    """The code that each line saw, sub-step by sub-step: (line, length)."""
    whole = np.lib.stride_tricks.sliding_window_view(code, length)
    return whole[: lines * substeps : substeps].astype(np.float64)
