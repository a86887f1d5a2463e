"""The watcher in this process: lines go through real rings, what it says comes out of a mailbox."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from test_lightcheck import Altered, recorded
from test_recorder import Post

from acquire.flags import ARMS, LineFlag
from acquire.processes.shared import Counters
from acquire.stream.lightcheck import Judge, Verdict
from acquire.stream.messages import Checked, Note
from acquire.stream.ring import Ring, RingShape
from acquire.stream.threshold import ThresholdPlan
from acquire.stream.watcher import COUNTERS, VERDICTS, Watcher, WatchPlan

ROWS, CHECK = 128, 2048
STAGES = 64


class Bed:
    """Rings through which the lines of a scene go, and the watcher that looks at them after each block."""

    def __init__(self, threshold: ThresholdPlan | None = None, late: int = 0) -> None:
        self.lines, stages, substeps, white, code = recorded("scene-usaf")
        judge = Judge(stages, substeps, Altered(code, late=late), white, {})
        plan = WatchPlan(judge, CHECK, {"a": 0.0, "b": 0.0}, threshold)
        shape = RingShape(slots=32, rows=ROWS, width=STAGES, dtype="uint16", observers=2)
        self.rings = {arm: Ring(arm, shape) for arm in ARMS}
        self.counters = Counters(COUNTERS)
        self.post = Post()
        self.next = 0
        self.pass_by(1, look=False)
        self.watcher = Watcher(self.post, plan, self.rings, self.counters)
        self.now_s = 0.0

    def pass_by(
        self, blocks: int, slip_b: int = 0, lose: str = "", damage: str = "", look: bool = True
    ) -> None:
        """Lines ``1000 + next …`` of both arms; those of b may be ``slip_b`` lines behind."""
        for _ in range(blocks):
            for arm in ARMS:
                if arm != lose:
                    self.put(arm, self.next - (slip_b if arm == "b" else 0), damaged=arm == damage)
            self.next += ROWS
            if look:
                self.turn()

    def put(self, arm: str, at: int, damaged: bool = False) -> None:
        ring = self.rings[arm]
        slot = ring.claim(1000 + self.next, ROWS)
        assert slot is not None
        slot.pixels[:] = 4095 if damaged else self.lines[arm][at : at + ROWS]
        slot.flags[:] = LineFlag.INCOMPLETE if damaged else 0
        ring.commit(slot)
        ring.acquire()
        ring.release()

    def turn(self) -> None:
        self.now_s += 0.1
        self.watcher.turn(self.now_s)

    def verdicts(self) -> list[Verdict]:
        return [VERDICTS[self.counters[f"verdict_{arm}"]] for arm in ARMS]

    def close(self) -> None:
        self.watcher.close()
        for ring in self.rings.values():
            ring.close()
        self.counters.close()
        self.post.close()


@pytest.fixture
def beds() -> Iterator[list[Bed]]:
    made: list[Bed] = []
    yield made
    for bed in made:
        bed.close()


def test_lines_that_follow_the_code_are_reported_once(beds: list[Bed]) -> None:
    bed = Bed()
    beds.append(bed)
    bed.turn()
    bed.pass_by(15)
    assert bed.verdicts() == [Verdict.UNKNOWN, Verdict.UNKNOWN]
    bed.pass_by(40)
    assert bed.verdicts() == [Verdict.VERIFIED, Verdict.VERIFIED]
    assert bed.post.said == [
        Note(1000 + ROWS, "code_verified_a", "verified"),
        Note(1000 + ROWS, "code_verified_b", "verified"),
        Checked(1000 + ROWS, False, "arm a verified, arm b verified"),
    ]
    assert bed.counters["checks_a"] == 3  # of 16 blocks each
    assert bed.counters["checked_line_b"] <= 1000 + bed.next


def test_a_slip_in_mid_stream_is_reported(beds: list[Bed]) -> None:
    bed = Bed()
    beds.append(bed)
    bed.pass_by(18)
    sure, slip = bed.counters["verified_line_b"], 1000 + bed.next
    assert slip - 2 * CHECK < sure < slip
    bed.pass_by(40, slip_b=1)
    assert bed.verdicts() == [Verdict.VERIFIED, Verdict.SHIFTED]
    doubts = [note for note in bed.post.said if isinstance(note, Note) and "doubtful" in note.kind]
    assert doubts == [Note(sure, "code_doubtful_b", "shifted by +3 sub-steps")]
    last = bed.post.said[-1]
    assert isinstance(last, Checked)
    assert last.doubtful
    assert last.text == "arm a verified, arm b shifted by +3 sub-steps: arm b is 1 lines behind arm a"
    assert (bed.counters["shift_a"], bed.counters["shift_b"]) == (0, 3)


def test_a_slip_that_is_undone_is_doubted_as_long_as_it_lasts(beds: list[Bed]) -> None:
    bed = Bed()
    beds.append(bed)
    bed.pass_by(18)
    first = 1000 + bed.next
    bed.pass_by(18, slip_b=1)
    end = 1000 + bed.next
    bed.pass_by(26)
    _, doubt, back = [note for note in bed.post.said if isinstance(note, Note) and note.kind.endswith("_b")]
    assert (doubt.kind, back.kind) == ("code_doubtful_b", "code_verified_b")
    assert first - 2 * CHECK < doubt.line < first
    assert end <= back.line <= 1000 + bed.next


def test_lost_lines_and_lapped_slots_only_delay_a_verdict(beds: list[Bed]) -> None:
    bed = Bed()
    beds.append(bed)
    bed.turn()
    bed.pass_by(4)
    bed.pass_by(1, lose="b")
    bed.pass_by(2)
    bed.pass_by(33, look=False)  # more than a ring holds
    assert bed.verdicts() == [Verdict.UNKNOWN, Verdict.UNKNOWN]
    bed.turn()
    assert bed.counters["lapped_a"] > 0
    assert bed.post.said == []
    bed.pass_by(18)
    assert bed.verdicts() == [Verdict.VERIFIED, Verdict.VERIFIED]


@pytest.mark.parametrize("arm", ARMS)
def test_frames_that_arrive_damaged_or_not_at_all_prove_nothing_against_the_code(
    beds: list[Bed], arm: str
) -> None:
    bed = Bed(ThresholdPlan(arm, 4000.0, 100.0, rising=True, average_lines=64))
    beds.append(bed)
    bed.turn()
    for damage, lose in ((arm, ""), ("", arm), (arm, "")):
        bed.pass_by(4)
        bed.pass_by(1, damage=damage, lose=lose)
    bed.pass_by(2)
    assert bed.verdicts() == [Verdict.VERIFIED, Verdict.VERIFIED]
    assert not [note for note in bed.post.said if "verified" not in str(note)]


def test_a_check_with_hardly_any_line_begins_again(beds: list[Bed]) -> None:
    bed = Bed()
    beds.append(bed)
    bed.turn()
    bed.pass_by(7)
    bed.pass_by(10, damage="b")
    assert (bed.counters["checks_b"], bed.post.said) == (0, [])
    bed.pass_by(18)
    assert bed.verdicts() == [Verdict.VERIFIED, Verdict.VERIFIED]


def test_lines_of_a_saturated_camera_prove_nothing_against_the_code(beds: list[Bed]) -> None:
    bed = Bed(late=-2)
    beds.append(bed)
    bed.lines = {"a": bed.lines["a"], "b": np.minimum(30.0 * bed.lines["b"], 4095).astype(np.uint16)}
    bed.turn()
    bed.pass_by(17)
    assert bed.counters["checks_b"] == 1
    assert bed.verdicts() == [Verdict.UNKNOWN, Verdict.UNKNOWN]
    assert bed.post.said == []


def test_a_crossing_is_reported_with_its_line(beds: list[Bed]) -> None:
    bed = Bed(ThresholdPlan("b", 3000.0, 100.0, rising=True, average_lines=64))
    beds.append(bed)
    bed.pass_by(3)
    bed.lines = {"a": bed.lines["a"], "b": bed.lines["b"].copy()}
    bed.lines["b"][4 * ROWS + 64 : 5 * ROWS] = 3500
    bed.pass_by(4)
    notes = [note for note in bed.post.said if isinstance(note, Note)]
    assert notes == [Note(1000 + 4 * ROWS + 64, "threshold", "arm b above 3000 DN")]


def test_a_level_that_is_crossed_all_the_time_is_reported_now_and_then(beds: list[Bed]) -> None:
    bed = Bed(ThresholdPlan("b", 3000.0, 100.0, rising=True, average_lines=1))
    beds.append(bed)
    bed.lines = {"a": bed.lines["a"], "b": bed.lines["b"].copy()}
    bed.lines["b"][2 * ROWS : 4 * ROWS : 8] = 4000
    bed.pass_by(4)
    notes = [note for note in bed.post.said if isinstance(note, Note)]
    assert [note.line for note in notes] == [1000 + 2 * ROWS, 1000 + 3 * ROWS]
    assert notes[1].text == f"arm b above 3000 DN, {ROWS // 8 - 1} more times before"


def test_a_light_that_comes_late_is_reported_from_the_first_check_on(beds: list[Bed]) -> None:
    bed = Bed(late=-2)
    beds.append(bed)
    bed.turn()
    bed.pass_by(17)
    assert bed.post.said == [
        *(Note(0, f"code_doubtful_{arm}", "shifted by +2 sub-steps") for arm in ARMS),
        Checked(1000 + ROWS, True, "arm a shifted by +2 sub-steps, arm b shifted by +2 sub-steps"),
    ]
    assert np.all([bed.counters[f"shift_{arm}"] == 2 for arm in ARMS])
