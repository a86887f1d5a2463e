"""Code, ticks and time of lines, computed the slow way; and tags that agree or do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.clock import ClockFit
from acquire.codes import PrbsCode
from acquire.lines import LineBlock, LineFlag
from acquire.stream.tagger import Tagger, tag_rows
from acquire.trigger.base import LineTag, TriggerRun

CODE = PrbsCode(31, 12345)
CLOCK = ClockFit(90_000_000, 1_700_000_000_123_456_789, 500)
STAGES = 64


def make_tagger(substeps: int = 3, ticks: int = 900) -> Tagger:
    return Tagger(TriggerRun("r", CODE, substeps, ticks, 256), STAGES, CLOCK)


def make_block(first_line: int, count: int) -> LineBlock:
    return LineBlock(first_line, np.ones((count, 4), np.uint8), np.zeros(count, np.uint16))


def right_tag(line: int, substeps: int = 3, ticks: int = 900) -> LineTag:
    return LineTag(line, line * substeps, line * substeps * ticks)


@given(
    first=st.one_of(st.integers(0, 20_000), st.integers(8000, 8200), st.integers(10**11, 10**12)),
    count=st.integers(1, 300),
    substeps=st.integers(1, 8),
    ticks=st.integers(5, 5000),
)
def test_every_line_has_its_code_and_time(first: int, count: int, substeps: int, ticks: int) -> None:
    tagged = make_tagger(substeps, ticks).tag("a", make_block(first, count))
    tags = tagged.tags
    assert (tagged.first_line, tagged.end_line, len(tagged)) == (first, first + count, count)
    for k in {0, count // 2, count - 1}:
        line = first + k
        bits = CODE.bits(line * substeps, substeps)
        tick = (line * substeps + STAGES * substeps - 1) * ticks
        assert int(tags.code_index[k]) == line * substeps
        assert int(tags.code[k]) == sum(int(bit) << u for u, bit in enumerate(bits))
        assert int(tags.tick[k]) == tick
        assert int(tags.time_ns[k]) == CLOCK.utc_ns_at_tick_0 + tick * 10**9 // CLOCK.clock_hz
    types = [a.dtype for a in (tags.code_index, tags.code, tags.tick, tags.time_ns, tagged.flags)]
    assert types == [np.uint64, np.uint8, np.uint64, np.int64, np.uint16]


def test_arms_that_are_far_apart_get_the_same_answers() -> None:
    tagger, fresh = make_tagger(), make_tagger()
    for step in range(12):
        for first in (step * 5000, 10**6 + step * 5000):
            mine, theirs = tagger.table(first, 4000), fresh.table(first, 4000)
            assert np.array_equal(mine.code, theirs.code)
            assert np.array_equal(mine.tick, theirs.tick)
        fresh = make_tagger()


def test_lines_beyond_the_last_tag_are_flagged_and_the_camera_s_flags_stay_untouched() -> None:
    tagger = make_tagger()
    assert tagger.verify(tag_rows([right_tag(0), right_tag(256)])) == []
    assert tagger.confirmed_end == 257
    block = make_block(250, 20)
    block.flags[:] = LineFlag.SATURATED
    flags = tagger.tag("a", block).flags
    unconfirmed = LineFlag.TIME_ESTIMATED | LineFlag.CODE_UNVERIFIED
    assert (flags[:7] == LineFlag.SATURATED).all()
    assert (flags[7:] == LineFlag.SATURATED | unconfirmed).all()
    assert (block.flags == LineFlag.SATURATED).all()


@pytest.mark.parametrize(
    ("tag", "text"),
    [
        (LineTag(512, 512 * 3 + 1, 512 * 2700), "code index 1537, tick 1382400; expected 1536"),
        (LineTag(512, 512 * 3, 512 * 2700 - 900), "tick 1381500; expected 1536 and 1382400"),
        (LineTag(2**63 + 5, 1, 1), "tag of line 9223372036854775813"),
        (right_tag(0), "started again"),
        (right_tag(256), "started again"),
    ],
)
def test_a_tag_that_contradicts_the_count_is_reported_and_confirms_nothing(tag: LineTag, text: str) -> None:
    tagger = make_tagger()
    found = tagger.verify(tag_rows([right_tag(256), tag]))
    assert [mismatch.tag for mismatch in found] == [tag]
    assert text in str(found[0])
    assert tagger.confirmed_end == 257


def test_one_wrong_tag_does_not_spoil_those_after_it() -> None:
    tagger = make_tagger()
    assert len(tagger.verify(tag_rows([right_tag(256), LineTag(10**9, 0, 0), right_tag(512)]))) == 1
    assert tagger.confirmed_end == 513


def test_after_a_restart_of_the_trigger_nothing_is_confirmed_any_more() -> None:
    tagger = make_tagger()
    tagger.verify(tag_rows([right_tag(line) for line in (0, 256, 512)]))
    assert len(tagger.verify(tag_rows([right_tag(line) for line in (0, 256, 512, 768)]))) == 1
    assert tagger.verify(tag_rows([right_tag(1024)])) == []
    assert tagger.confirmed_end == 513


def test_no_tags_are_no_news() -> None:
    tagger = make_tagger()
    assert tagger.verify(tag_rows([])) == []
    assert tagger.confirmed_end == 0
