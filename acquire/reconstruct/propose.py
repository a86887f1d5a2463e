"""``--auto``: a plan for a selection, from how fast each stretch of it changes."""

from __future__ import annotations

from collections import deque
from itertools import groupby, pairwise
from typing import TYPE_CHECKING

from acquire.calibrate import calibrated
from acquire.config.plan import ReconstructionPlan, SegmentPlan
from acquire.recon.auto import TEMPORAL_MERGES, Tempo, tempo
from acquire.recon.segments import Stretch, Voxels, split
from acquire.reconstruct.liveliest import speaker

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from acquire.calibrate import Calibration
    from acquire.fibre import Tile
    from acquire.reconstruct.select import Selection
    from acquire.store import Recording

LOOKED_AT = 4
"""Length of a stretch that is judged by itself, in n; a change is located no better than that."""
LONGEST = 12
"""Sub-segments are no longer than this, in n."""
VOXELS_OF_A_TILE = 64
"""Along a side, as many as the paper's smallest: of a tile without intra-line steps, S = 1 would be far more
voxels than its lines can tell."""
PLACES = 9
"""Stretches that are looked at first, evenly spaced; between two that differ more, until the change is found.

A look takes as long as a short reconstruction. What changes and changes back between two places that are
alike is not seen: a shorter selection is looked at throughout.
"""


def propose(
    recording: Recording,
    selection: Selection,
    *,
    whole: bool = False,
    progress: Callable[[float, int], object] | None = None,
    calibration: Calibration | None = None,
    tiles: Sequence[Tile] = (),
) -> ReconstructionPlan:
    """Sub-segments of neighbouring stretches that are equally fast, each with the reason.

    Behind a fibre they follow the tile where most changes, of ``tiles``, and the reason names it.
    """
    stream = selection.stream
    size = stream.geometry(1).size
    begin, end = selection.extent(Voxels(1, 1), Voxels(1, 1), whole=whole)
    stretches = split(begin, end, Voxels(1, 1), LOOKED_AT * size)
    tile = speaker(recording, tiles, (stream.first_line, stream.end_line - stream.first_line), calibration)
    side = None if tile is None else _side_in_tile(stream.substeps, size)

    def look(number: int, done: Callable[[float], object]) -> Tempo:
        # lines that see nothing else: what the neighbours do is judged with them
        stretch = stretches[number]
        inner = stream.sub_segment(Stretch(stretch.begin, stretch.end, Voxels(1, size)))
        lines = recording.cut(inner.first_line, inner.lines, tile)
        return tempo(lines if calibration is None else calibrated(lines, calibration), done, side)

    found = list(zip(stretches, _tempos(len(stretches), look, progress), strict=True))
    groups = [list(group) for _, group in groupby(found, key=lambda each: each[1].voxels)]
    parts = [part for group in groups for part in _parts(group, LONGEST // LOOKED_AT)]
    if tile is not None:
        parts = [part.model_copy(update={"why": f"tile {tile}: {part.why}"}) for part in parts]
    last = parts.pop().model_copy(update={"substeps": None})
    return ReconstructionPlan(ends="whole" if whole else "trusted", segments=(*parts, last))


def _side_in_tile(substeps: int, size: int) -> int:
    """The voxels' side for what moves behind a fibre: S, as it is elsewhere, or as many as make a tile of 64
    voxels; they must fill it."""
    least = min(size, max(substeps, size // VOXELS_OF_A_TILE))
    return next(side for side in range(least, size + 1) if not size % side)


def _tempos(
    count: int,
    look: Callable[[int, Callable[[float], object]], Tempo],
    progress: Callable[[float, int], object] | None,
) -> list[Tempo]:
    """Of every stretch: looked at, or between two that were looked at and are in the same voxels."""
    places = sorted({round(i * (count - 1) / max(1, PLACES - 1)) for i in range(PLACES)})
    known: dict[int, Tempo] = {}
    tell = progress or (lambda _done, _of: None)
    waiting = deque(places)
    while waiting:
        place = waiting.popleft()
        known[place] = look(place, lambda share: tell(len(known) + share, len(known) + 1 + len(waiting)))
        if not waiting:
            waiting.extend(_between(known))
        tell(len(known), len(known) + len(waiting))
    return [known[max(place for place in known if place <= number)] for number in range(count)]


def _between(known: Mapping[int, Tempo]) -> list[int]:
    """The middle between neighbours that differ and have something between them."""
    return [
        (one + other) // 2
        for one, other in pairwise(sorted(known))
        if other - one > 1 and not _alike(known[one].voxels, known[other].voxels)
    ]


def _alike(one: Voxels, other: Voxels) -> bool:
    """Stills are as long as what was looked at, which differs by a line or two."""
    slow = max(TEMPORAL_MERGES)
    lengths = {min(voxels.temporal_merge, slow + 1) for voxels in (one, other)}
    return one.spatial_merge == other.spatial_merge and len(lengths) == 1


def _parts(found: list[tuple[Stretch, Tempo]], most: int) -> list[SegmentPlan]:
    """Stretches in the same voxels, at most ``most`` of them in a sub-segment."""
    groups = [found[i : i + most] for i in range(0, len(found), most)]
    return [_part(group) for group in groups]


def _part(found: list[tuple[Stretch, Tempo]]) -> SegmentPlan:
    voxels = found[0][1].voxels
    return SegmentPlan(
        substeps=found[-1][0].end - found[0][0].begin,
        spatial_merge=voxels.spatial_merge,
        temporal_merge=voxels.temporal_merge,
        why=max(found, key=lambda each: each[1].tried[-1][1])[1].why,
    )
