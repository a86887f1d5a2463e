"""Frame ids, counters and time stamps to line numbers: against a model that loses frames at random."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from acquire.camera.base import CameraLoss, LossCause
from acquire.camera.frames import FrameCount, FrameFacts

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
