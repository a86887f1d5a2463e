"""Frames that one of the arms did not see at all: lines that were lost, saturated or masked for too long."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from acquire.lines import Segment

Range = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Unseen:
    """Sub-steps ``begin`` to ``end`` of the recording, of which an arm has no usable sample, and its lines.

    Lines ``first_line`` to ``last_line`` are all that see them; ``why`` states what makes them unusable.
    """

    begin: int
    end: int
    arm: str
    first_line: int
    last_line: int
    why: str

    def to_dict(self) -> dict[str, Any]:
        """Return frames, arm and lines as JSON, as provenance of a video states them."""
        return asdict(self)

    def words(self, first_frame: int, last_frame: int) -> str:
        """Return the warning about these frames of a video."""
        frames = (
            f"frame {first_frame} is"
            if first_frame == last_frame
            else (f"frames {first_frame} to {last_frame} are")
        )
        return (
            f"{frames} not trusted: arm {self.arm} has no usable sample of them, since all of its lines "
            f"{self.first_line} to {self.last_line} are {self.why}; of the frames before and after, the "
            "longest run counts as trusted"
        )


def find_unseen(segment: Segment, temporal_merge: int) -> list[Unseen]:
    """Return the frames of T_m sub-steps that an arm did not see, consecutive ones together.

    One arm alone does not determine a frame: the video then shows what the prior makes of the other's lines.
    """
    S, L, n = segment.geometry.substeps, segment.geometry.lines, segment.geometry.size
    begins = np.arange(0, segment.geometry.span, temporal_merge)
    ends = np.minimum(begins + temporal_merge, segment.geometry.span)
    # Line ℓ exposes the sub-steps ℓS .. ℓS + n + S − 2.
    first = np.clip(-(-(begins - (n + S - 2)) // S), 0, L)
    last = np.clip((ends - 1) // S + 1, 0, L)
    origin, found = S * segment.first_line, []
    usable_lines: NDArray[np.bool_] = np.logical_or.reduce(segment.mask, axis=2)
    for arm, usable, lines in zip("ab", usable_lines, segment.lines, strict=True):
        running = np.concatenate([[0], np.cumsum(usable)])
        unseen = np.concatenate([[False], running[last] == running[first], [False]])
        edges = np.flatnonzero(unseen[1:] != unseen[:-1])
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            low, high = int(first[start]), int(last[stop - 1])
            found.append(
                Unseen(
                    begin=origin + int(begins[start]),
                    end=origin + int(ends[stop - 1]),
                    arm=arm,
                    first_line=segment.first_line + low,
                    last_line=segment.first_line + high - 1,
                    # Lost lines keep their place, filled with 0.
                    why="saturated, damaged or masked" if lines[low:high].any() else "lost",
                )
            )
    return found


def trusted_frames(segment: Segment, temporal_merge: int) -> tuple[slice, tuple[str, ...]]:
    """Return the longest run of frames that both arms saw in full, and a warning for each range of others."""
    T_m, origin = temporal_merge, segment.geometry.substeps * segment.first_line
    sampled = segment.geometry.trusted_frames(T_m)
    whole = (origin + T_m * sampled.start, origin + T_m * sampled.stop)
    unseen = within(find_unseen(segment, T_m), *whole)
    first, stop = ((edge - origin) // T_m for edge in longest(remaining(whole, unseen), whole[0]))
    words = [each.words((each.begin - origin) // T_m, -(-(each.end - origin) // T_m) - 1) for each in unseen]
    return slice(first, stop), tuple(words)


def within(unseen: Iterable[Unseen], begin: int, end: int) -> list[Unseen]:
    """Return what lies in ``begin`` to ``end``; ranges of one arm that meet become one."""
    joined: list[Unseen] = []
    for each in sorted(unseen, key=lambda one: (one.arm, one.begin)):
        part = replace(each, begin=max(begin, each.begin), end=min(end, each.end))
        if part.begin >= part.end:
            continue
        before = joined[-1] if joined else None
        if before is None or before.arm != part.arm or before.end < part.begin:
            joined.append(part)
            continue
        joined[-1] = replace(
            before,
            end=max(before.end, part.end),
            first_line=min(before.first_line, part.first_line),
            last_line=max(before.last_line, part.last_line),
            why=max(before.why, part.why),  # the longer of the two names more causes
        )
    return joined


def remaining(whole: Range, unseen: Sequence[Unseen]) -> list[Range]:
    """Return the parts of a range that both arms have seen, in order."""
    parts, edge = [], whole[0]
    for each in sorted(unseen, key=lambda one: one.begin):
        if edge < min(each.begin, whole[1]):
            parts.append((edge, min(each.begin, whole[1])))
        edge = max(edge, each.end)
    return parts + ([(edge, whole[1])] if edge < whole[1] else [])


def longest(ranges: Iterable[Range], default: int) -> Range:
    """Return the longest range, or an empty one at ``default``."""
    return max(ranges, key=lambda each: each[1] - each[0], default=(default, default))
