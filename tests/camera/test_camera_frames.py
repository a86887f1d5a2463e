"""Frame ids, counters and time stamps to line numbers: against models that lose frames at random."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.camera.base import CameraLoss, LossCause
from acquire.camera.frames import FrameCount, FrameFacts, Tally
from acquire.errors import CameraError, CameraLostError

H = 10
FATES = st.sampled_from(["come", "come", "come", "link", "starved"])


def wrapped(frame: int, bits: int, first: int) -> int:
    return first + frame % ((1 << bits) - first)


@given(
    fates=st.lists(FATES, min_size=1, max_size=200),
    bits=st.sampled_from([8, 16, 64]),
    first=st.sampled_from([0, 1]),
    told=st.booleans(),
)
def test_every_frame_has_its_lines_and_every_hole_its_cause(
    fates: list[str], bits: int, first: int, told: bool
) -> None:
    count = FrameCount(H, bits if told else 0, first)
    underruns, holes = 0, []
    for frame, fate in enumerate(fates):
        if fate != "come":
            underruns += fate == "starved"
            holes.append(fate)
            continue
        place = count.place(FrameFacts(wrapped(frame, bits, first), underruns))
        assert place.first_line == frame * H
        assert sum(loss.count for loss in place.losses) == len(holes) * H
        by_cause = {loss.cause: loss.count // H for loss in place.losses}
        assert by_cause.get(LossCause.NO_BUFFER, 0) == holes.count("starved")
        assert by_cause.get(LossCause.ID_GAP, 0) == holes.count("link")
        holes = []


def test_ids_may_begin_at_one() -> None:
    count = FrameCount(H)
    assert [count.place(FrameFacts(k)).first_line for k in (1, 2, 4)] == [0, 10, 30]


@given(
    misses=st.dictionaries(st.integers(6, 30), st.integers(1, 5), max_size=4),
    late=st.integers(0, 3),
)
def test_missed_triggers_are_found_in_their_frames_by_the_time_they_took(
    misses: dict[int, int], late: int
) -> None:
    """``late``: so many frames are read only after more have come, and the counter is ahead."""
    count, period_ns = FrameCount(H), 1000
    pulse, found = 0, {}
    for frame in range(40):
        seen = sum(n for at, n in misses.items() if at <= frame + late)
        place = count.place(FrameFacts(frame, missed=seen, time_ns=pulse * period_ns + 5))
        assert place.first_line == pulse
        if place.losses:
            (loss,) = place.losses
            found[frame - 1] = loss
        assert place.doubtful or frame not in misses
        pulse += H + misses.get(frame, 0)
    assert found == {at: CameraLoss(LossCause.MISSED_TRIGGER, n) for at, n in misses.items()}


def test_without_time_stamps_missed_triggers_are_before_the_next_frame() -> None:
    count = FrameCount(H)
    count.place(FrameFacts(0))
    assert count.place(FrameFacts(1, missed=2)).doubtful
    place = count.place(FrameFacts(2, missed=2))
    assert (place.first_line, place.doubtful) == (22, False)
    assert place.losses == (CameraLoss(LossCause.MISSED_TRIGGER, 2),)


@given(
    fates=st.lists(
        st.sampled_from(["come", "come", "come", "lost", "incomplete", "stale", "twice"]), max_size=100
    ),
    bits=st.sampled_from([8, 16, 32, 64]),
    skips=st.booleans(),
    begin=st.integers(2, 40),
    known=st.booleans(),
    behind=st.integers(1, 100),
)
def test_incomplete_and_stale_frames_are_no_evidence_near_a_wrap_or_far_from_it(
    fates: list[str], bits: int, skips: bool, begin: int, known: bool, behind: int
) -> None:
    """The ids begin ``begin`` frames before a wrap. ``known``: the transport says how wide ids are and
    whether they skip 0; else the time stamps of complete frames do.
    """
    count = FrameCount(H, bits if known else 0, None, skips if known else None)
    wrap = (1 << bits) - skips

    def facts(frame: int) -> FrameFacts:
        return FrameFacts(skips + (wrap - begin + frame) % wrap, time_ns=10**9 + frame * 1000)

    assert count.place(facts(0)).first_line == 0
    assert count.place(facts(1)).first_line == H
    hole: list[str] = []
    last = 1
    for frame, fate in enumerate(fates, start=2):
        if fate in ("lost", "incomplete"):
            hole.append(fate)
            continue
        if fate == "stale":
            assert count.place(facts(last - min(behind, last))) is None
        came = hole.count("incomplete")
        place = count.place(facts(frame), came)
        assert place.first_line == frame * H
        assert place.kept == (came == len(hole))
        lost = {loss.cause: loss.count // H for loss in place.losses}
        if place.kept:
            assert not lost
        else:
            gap = len(hole) - came
            assert lost == {LossCause.ID_GAP: gap} | ({LossCause.INCOMPLETE: came} if came else {})
        if fate == "twice":
            assert count.place(facts(frame)) is None
        hole, last = [], frame


def test_frames_without_a_number_before_the_first_one_count() -> None:
    place = FrameCount(H).place(FrameFacts(3), unnumbered=2)
    assert (place.first_line, place.losses, place.kept) == (20, (), True)


def test_frames_whose_lines_are_gone_are_lost_as_incomplete() -> None:
    count = FrameCount(H)
    count.place(FrameFacts(1))
    place = count.place(FrameFacts(4), unnumbered=2, keep=False)
    assert (place.first_line, place.losses) == (30, (CameraLoss(LossCause.INCOMPLETE, 20),))


def test_more_buffers_than_lost_frames_are_not_more_losses() -> None:
    """Late packets of a frame that was given up can begin a buffer of their own."""
    count = FrameCount(H)
    count.place(FrameFacts(1))
    place = count.place(FrameFacts(3), unnumbered=2)
    assert (place.first_line, place.losses) == (20, (CameraLoss(LossCause.INCOMPLETE, 10),))
    assert count.place(FrameFacts(4), unnumbered=1).losses == ()


@pytest.mark.parametrize("first", [64_000, 65_520])
def test_ids_that_begin_anywhere_wrap_as_the_time_stamps_say(first: int) -> None:
    for skips in (False, True):
        count = FrameCount(H)
        ids = [*range(first, 65_536), *range(int(skips), 10)]
        for k, number in enumerate(ids):
            if k in (len(ids) - 10, len(ids) - 11, len(ids) - 12):
                continue  # lost at the wrap
            assert count.place(FrameFacts(number, time_ns=k * 1000)).first_line == k * H


def test_a_camera_that_counts_anew_is_opened_again_and_not_ignored() -> None:
    count = FrameCount(H, 64)
    count.place(FrameFacts(10_000))
    for number in range(256):
        assert count.place(FrameFacts(number)) is None
    with pytest.raises(CameraLostError, match="after id 10000, 257 frames"):
        count.place(FrameFacts(256))


def test_a_first_frame_before_the_first_id_is_refused() -> None:
    with pytest.raises(CameraError, match="first frame has id 0, but ids are set to begin at 1"):
        FrameCount(H, first_id=1).place(FrameFacts(0))


@given(
    steps=st.lists(st.integers(0, 200), max_size=50),
    bits=st.sampled_from([16, 32, 64]),
    begin=st.integers(0, 300),
)
def test_a_counter_that_wraps_goes_on(steps: list[int], bits: int, begin: int) -> None:
    reading = (1 << bits) - begin - 1
    tally, total = Tally(reading), 0
    for step in steps:
        reading, total = (reading + step) % (1 << bits), total + step
        assert tally.note(reading) == total


def test_a_counter_that_is_reset_counts_from_0() -> None:
    tally = Tally(40)
    assert [tally.note(reading) for reading in (50, 3, 4)] == [10, 13, 14]
