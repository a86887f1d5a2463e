"""One choice of prior, weight and band for all tiles behind a fibre, or for the sub-segments of a stretch.

The search for them is most of what a tile takes. It is made on the tile where most changes, by its lines
alone, and handed to the others, which keep it where it predicts their own held-out samples as closely
(`acquire.recon.reuse`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from acquire.reconstruct.liveliest import liveliest
from acquire.reconstruct.work import as_read

if TYPE_CHECKING:
    from collections.abc import Sequence

    from acquire.fibre import Tile
    from acquire.recon.reuse import Choice
    from acquire.recon.segments import Voxels
    from acquire.reconstruct.select import VideoRequest
    from acquire.reconstruct.work import Options, Part, Task
    from acquire.store import Recording


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
    """The tiles of a request, that one first whose lines show most: see `liveliest`."""
    segments = request.sub_segments()
    middle = segments[len(segments) // 2]
    first = liveliest(
        recording,
        request.tiles,
        (middle.first_line, middle.lines),
        lambda lines: as_read(lines, options),
        moving=request.grid.voxels.temporal_merge < middle.lines * request.stream.substeps,
    )
    return (first, *(tile for tile in request.tiles if tile != first))
