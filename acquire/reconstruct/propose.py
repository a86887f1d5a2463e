"""``--auto``: a plan for a selection, from the speed of change in each of its ranges."""

from __future__ import annotations

from collections import deque
from itertools import groupby, pairwise
from typing import TYPE_CHECKING

from acquire.calibrate import calibrated
from acquire.config.plan import ReconstructionPlan, SegmentPlan
from acquire.recon.auto import TEMPORAL_MERGES, Tempo, tempo
from acquire.recon.segments import Stretch, Voxels, split
from acquire.reconstruct.liveliest import representative_tile

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from acquire.calibrate import Calibration
    from acquire.fibre import Tile
    from acquire.reconstruct.select import Selection
    from acquire.store import Recording

LOOKED_AT = 4
"""Length of a range that is judged separately, in n; changes are located no more precisely than that."""
LONGEST_SEGMENT = 12
"""Upper limit on the length of a sub-segment, in n."""
VOXELS_OF_A_TILE = 64
"""Voxels along a side of a tile, as in the paper's smallest scene. Without intra-line steps, voxels of S = 1
would be far more than the lines determine."""
PLACES = 9
"""Evenly spaced ranges that are examined first. Between two that differ, more are, until the change is found.

Examining one takes as long as a short reconstruction. A change that is reversed between two ranges that are
alike goes unnoticed; a short selection is examined completely.
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
    """Propose sub-segments of neighbouring ranges that change equally fast, each with the reason.

    Behind a fibre they follow that of the ``tiles`` with the most activity, and the reason names it.
    """
    stream = selection.stream
    size = stream.geometry(1).size
    begin, end = selection.extent(Voxels(1, 1), Voxels(1, 1), whole=whole)
    stretches = split(begin, end, Voxels(1, 1), LOOKED_AT * size)
    lines_of_stream = (stream.first_line, stream.end_line - stream.first_line)
    tile = representative_tile(recording, tiles, lines_of_stream, calibration)
    side = None
    if tile is not None:
        # As elsewhere S, or as large as gives a tile of 64 voxels; voxels must fill the tile.
        least = min(size, max(stream.substeps, size // VOXELS_OF_A_TILE))
        side = next(side for side in range(least, size + 1) if not size % side)

    def look(number: int, done: Callable[[float], object]) -> Tempo:
        # Only lines exposed within this range: changes in its neighbours are judged with those.
        stretch = stretches[number]
        inner = stream.sub_segment(Stretch(stretch.begin, stretch.end, Voxels(1, size)))
        lines = recording.cut(inner.first_line, inner.lines, tile)
        return tempo(lines if calibration is None else calibrated(lines, calibration), done, side)

    found = list(zip(stretches, _tempos(len(stretches), look, progress), strict=True))
    groups = [list(group) for _, group in groupby(found, key=lambda each: each[1].voxels)]
    # These are the ranges of a group that one sub-segment may hold.
    most = LONGEST_SEGMENT // LOOKED_AT
    parts = [_part(group[i : i + most]) for group in groups for i in range(0, len(group), most)]
    if tile is not None:
        parts = [part.model_copy(update={"why": f"tile {tile}: {part.why}"}) for part in parts]
    # Without a length it goes to the end of the selection.
    last = parts.pop().model_copy(update={"substeps": None})
    return ReconstructionPlan(ends="whole" if whole else "trusted", segments=(*parts, last))


def _tempos(
    count: int,
    look: Callable[[int, Callable[[float], object]], Tempo],
    progress: Callable[[float, int], object] | None,
) -> list[Tempo]:
    """Return the tempo of every range: as examined, or that of the alike ones on both sides of it."""
    places = sorted({round(i * (count - 1) / max(1, PLACES - 1)) for i in range(PLACES)})
    known: dict[int, Tempo] = {}
    kinds: dict[int, tuple[int, int]] = {}
    # Stills differ by a line or two in length: all longer than the longest T_m of a moving scene are alike.
    still = max(TEMPORAL_MERGES) + 1
    report = progress or (lambda _done, _of: None)
    waiting = deque(places)
    while waiting:
        place = waiting.popleft()
        known[place] = look(place, lambda share: report(len(known) + share, len(known) + 1 + len(waiting)))
        voxels = known[place].voxels
        kinds[place] = voxels.spatial_merge, min(voxels.temporal_merge, still)
        if not waiting:  # bisect between neighbours that differ
            waiting.extend(
                (one + other) // 2
                for one, other in pairwise(sorted(known))
                if other - one > 1 and kinds[one] != kinds[other]
            )
        report(len(known), len(known) + len(waiting))
    return [known[max(place for place in known if place <= number)] for number in range(count)]


def _part(found: list[tuple[Stretch, Tempo]]) -> SegmentPlan:
    """Return one sub-segment for neighbouring ranges with the same voxels."""
    voxels = found[0][1].voxels
    return SegmentPlan(
        substeps=found[-1][0].end - found[0][0].begin,
        spatial_merge=voxels.spatial_merge,
        temporal_merge=voxels.temporal_merge,
        # The reason is that of the range that was hardest to predict.
        why=max(found, key=lambda each: each[1].tried[-1][1])[1].why,
    )
