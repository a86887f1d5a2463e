"""Lines that several recordings hold count once: against sets of lines."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from acquire.stream.kept import Kept

TAKES = st.lists(
    st.tuples(st.integers(0, 60), st.lists(st.integers(1, 9), min_size=1, max_size=4), st.integers(0, 9)),
    max_size=6,
)
"""First line, lengths of the blocks, and how much of the last the disk did not keep."""


@given(takes=TAKES, first=st.integers(0, 110), count=st.integers(0, 40))
def test_a_line_counts_once(takes: list[tuple[int, list[int], int]], first: int, count: int) -> None:
    kept, expected = Kept(), set[int]()
    for line, blocks, cut in takes:
        kept.begin(0)
        end = line
        for block in blocks:
            kept.add(end, end + block)
            end += block
        end = max(line, end - cut)
        kept.end_at(end)
        expected |= set(range(line, end))
    asked = range(first, first + count)
    assert kept.count(asked.start, asked.stop) == len(expected & set(asked))


def test_a_gap_inside_a_recording_is_no_new_range_and_old_ranges_are_forgotten() -> None:
    kept = Kept([(0, 100)])
    kept.begin(50)
    kept.add(200, 210)
    kept.add(230, 240)  # what is between was lost: it will never come
    assert (kept.count(0, 100), kept.count(100, 200), kept.count(200, 240)) == (100, 0, 40)
    kept.begin(150)
    assert kept.count(0, 100) == 0


def test_a_recording_without_a_line_holds_none() -> None:
    kept = Kept()
    kept.begin(0)
    kept.end_at(500)
    assert kept.count(0, 1000) == 0
