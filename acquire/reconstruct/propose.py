"""``--auto``: a plan for a selection, from how fast each stretch of it changes."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

from acquire.plan_config import ReconstructionPlan, SegmentPlan
from acquire.recon.auto import Tempo, tempo
from acquire.recon.segments import Stretch, Voxels, split

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.reconstruct.select import Selection
    from acquire.store import Recording

LOOKED_AT = 4
"""Length of a stretch that is judged by itself, in n; a change is located no better than that."""
LONGEST = 12
"""Sub-segments are no longer than this, in n."""


def propose(
    recording: Recording,
    selection: Selection,
    *,
    whole: bool = False,
    progress: Callable[[int, int], object] | None = None,
) -> ReconstructionPlan:
    """Sub-segments of neighbouring stretches that are equally fast, each with the reason."""
    stream = selection.stream
    size = stream.geometry(1).size
    begin, end = selection.extent(Voxels(1, 1), Voxels(1, 1), whole=whole)
    stretches = split(begin, end, Voxels(1, 1), LOOKED_AT * size)
    found = []
    for number, stretch in enumerate(stretches):
        # lines that see nothing else: what the neighbours do is judged with them
        inner = stream.sub_segment(Stretch(stretch.begin, stretch.end, Voxels(1, size)))
        heard = tempo(recording.cut(inner.first_line, inner.lines))
        found.append((stretch, heard))
        if progress is not None:
            progress(number + 1, len(stretches))
    groups = [list(group) for _, group in groupby(found, key=lambda each: each[1].voxels)]
    parts = [part for group in groups for part in _parts(group, LONGEST // LOOKED_AT)]
    last = parts.pop().model_copy(update={"substeps": None})
    return ReconstructionPlan(ends="whole" if whole else "trusted", segments=(*parts, last))


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
