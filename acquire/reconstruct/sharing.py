"""One choice of prior, weight and band for all tiles behind a fibre, or for the sub-segments of a range.

The search for the choice is most of the work on a tile. It is made on the tile with the most activity, from
its lines alone, and handed on to the others. They keep it if it predicts their own held-out samples as
closely (`acquire.recon.reuse`).
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


class SharedChoices:
    """The first choice made for each kind of voxels. Unless ``enabled``, nothing is shared."""

    def __init__(self, enabled: bool) -> None:
        self._enabled = enabled
        self._choices: dict[Voxels, Choice | None] = {}
        self._searched: set[Voxels] = set()

    def pending(self, task: Task) -> bool:
        """Whether the choice that a task should start from is still being made."""
        return self._enabled and task.segment.voxels in self._searched - self._choices.keys()

    def with_choice(self, task: Task) -> Task:
        """Return the task with the shared choice; the first task of its kind searches."""
        if not self._enabled:
            return task
        self._searched.add(task.segment.voxels)
        return replace(task, choice=self._choices.get(task.segment.voxels))

    def record(self, task: Task, part: Part) -> None:
        """Record the choice of the first task of its kind; if it is None, every task searches."""
        # The first counts: later parts may have kept it, or searched for lines that it does not fit.
        self._choices.setdefault(task.segment.voxels, part.choice)


def sharing_facts(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """List the tiles, or numbers of sub-segments, that searched, kept or changed the shared choice (JSON)."""
    facts: dict[str, list[str]] = {"searched": [], "kept": [], "changed": []}
    for number, part in enumerate(parts, 1):
        kept = part["kept_choice"]
        outcome = "searched" if kept is None else "kept" if kept else "changed"
        facts[outcome].append(part["tile"] or str(number))
    return {outcome: list(dict.fromkeys(names)) for outcome, names in facts.items()}


def liveliest_first(recording: Recording, request: VideoRequest, options: Options) -> tuple[Tile, ...]:
    """Return the tiles of a request, the one with the most activity first: see `liveliest`."""
    segments = request.sub_segments()
    # There is one range for all tiles, so that their activity is comparable.
    middle = segments[len(segments) // 2]
    first = liveliest(
        recording,
        request.tiles,
        (middle.first_line, middle.lines),
        lambda lines: as_read(lines, options),
        # A single frame of all lines shows no change.
        moving=request.grid.voxels.temporal_merge < middle.lines * request.stream.substeps,
    )
    return (first, *(tile for tile in request.tiles if tile != first))
