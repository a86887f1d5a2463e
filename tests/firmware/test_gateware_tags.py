"""The tagger alone: every event is reported, whatever happens in the same clock."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest
from bench import simulate

from acquire.trigger import registers as r
from acquire.trigger.registers import TagFlag
from firmware.tagger import SEQUENCE_BITS, Tagger

FIRST, SECOND = TagFlag.MISSED_A, TagFlag.UNEXPECTED_B


def run(events: dict[int, int], lines: set[int], full: range = range(0)) -> list[tuple[int, r.TagRecord]]:
    """The tags (sequence, record) of 40 clocks: flags by clock, clocks with a line, clocks without room."""
    tagger, tags = Tagger(), []

    async def bench(context: Any) -> None:
        context.set(tagger.interval, 1)
        line = -1
        for clock in range(40):
            line += clock in lines
            context.set(tagger.now, clock)
            context.set(tagger.events, events.get(clock, 0))
            context.set(tagger.line, clock in lines)
            context.set(tagger.line_number, max(line, 0))
            context.set(tagger.full, clock in full)
            if context.get(tagger.put):
                entry = context.get(tagger.entry)
                tag = r.unpack_tag((entry >> SEQUENCE_BITS).to_bytes(r.TAG_BYTES, "little"))
                tags.append((entry & 0xFFFF, tag))
            await context.tick()

    simulate(tagger, bench)
    return tags


@pytest.mark.parametrize(("apart", "line"), list(product(range(5), range(8, 14))))
def test_events_close_to_each_other_and_to_a_line_are_all_reported(apart: int, line: int) -> None:
    events = {10: int(FIRST)}
    events[10 + apart] = events.get(10 + apart, 0) | int(SECOND)
    tags = run(events, {2, line})
    told = [flag for _, tag in tags for flag in (FIRST, SECOND) if tag.flags & flag]
    assert sorted(told) == sorted([FIRST, SECOND])
    assert [tag.timestamp for _, tag in tags if tag.flags & TagFlag.LINE] == [2, line]
    assert [number for number, _ in tags] == list(range(len(tags)))
    times = [tag.timestamp for _, tag in tags]
    assert times == sorted(times)
    assert all(0 <= tag.timestamp - 10 <= 15 for _, tag in tags if tag.flags & FIRST)


def test_an_event_waits_for_room_and_a_line_does_not() -> None:
    tags = run({12: int(TagFlag.LAST)}, {2, 8, 30}, full=range(6, 20))
    assert [(number, tag.line, tag.flags) for number, tag in tags] == [
        (0, 0, TagFlag.LINE | TagFlag.FIRST),
        (2, 1, TagFlag.LAST | TagFlag.TAGS_LOST),
        (3, 2, TagFlag.LINE),
    ]
