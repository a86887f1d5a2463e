"""One recording against a writer that only remembers: each line has its row, whatever was lost."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.clock import ClockFit
from acquire.codes import PrbsCode
from acquire.errors import DataError
from acquire.lines import ARMS, LineFlag, TaggedBlock
from acquire.store import RunCondition
from acquire.stream.losses import MAX_LOSSES, Cause, Loss, LossLog
from acquire.stream.ring import RingBlock
from acquire.stream.session import Session
from acquire.stream.tagger import Tagger, tag_rows
from acquire.trigger.base import LineTag, TriggerRun

WIDTH = 3
RUN = TriggerRun("r", PrbsCode(15, 77), 3, 900, 256)


@dataclass
class MemoryWriter:
    """`RecordingWriter` without a disk; ``broken`` refuses from then on what it names."""

    blocks: dict[str, list[TaggedBlock]] = field(default_factory=lambda: {arm: [] for arm in ARMS})
    gaps: list[tuple[str, int, int, str]] = field(default_factory=list)
    events: list[tuple[str, int, str]] = field(default_factory=list)
    ending: tuple[RunCondition, str, dict[str, Any]] | None = None
    closed: bool = False
    broken: tuple[str, ...] = ()
    error: Exception | None = None
    committed_lines: int = 0
    kept_lines: int = 0
    nearly_full: str | None = None
    beyond_bytes: int = 0
    events_not_listed: int = 0
    packs: bool = False

    def append(self, block: TaggedBlock, *, lent: bool = False) -> None:
        self._refuse("append")
        taken = self.blocks[block.arm]
        assert not taken or taken[-1].end_line == block.first_line, "rows must follow one another"
        # The ring takes its memory back.
        taken.append(replace(block, pixels=block.pixels.copy(), flags=block.flags.copy()))

    def give_back(self, arm: str) -> None:
        self._refuse("give_back")

    def add_gap(self, arm: str, first_line: int, count: int, cause: str) -> None:
        self.gaps.append((arm, first_line, count, str(cause)))

    def add_event(self, kind: str, tick: int, line: int, text: str = "") -> None:
        self.events.append((kind, line, text))

    def commit(self) -> None:
        self._refuse("commit")

    def seal(self, condition: RunCondition, end_reason: str, ledger: dict[str, Any]) -> None:
        self._refuse("seal")
        self.ending = condition, end_reason, ledger

    def rescue(self) -> int:
        return self.kept_lines

    def close(self) -> None:
        self.closed = True

    def column(self, arm: str, name: str) -> np.ndarray:
        return np.concatenate([getattr(block, name) for block in self.blocks[arm]])

    def _refuse(self, name: str) -> None:
        if name in self.broken and self.error is not None:
            raise self.error
        if name in self.broken:
            raise DataError(f"{name}: no space left", possible="0 lines can be read", hint="free space")


def value_of(arm: str, line: int) -> int:
    return (line * 3 + ARMS.index(arm)) % 60_000 + 1


def ring_block(arm: str, first: int, count: int, losses: tuple[Loss, ...] = (), flag: int = 0) -> RingBlock:
    values = [value_of(arm, line) for line in range(first, first + count)]
    pixels = np.repeat(np.array(values, np.uint16)[:, None], WIDTH, axis=1)
    return RingBlock(first, pixels, np.full(count, flag, np.uint16), 0, losses)


def make_session(
    writer: MemoryWriter, first_line: int = 0, lines: int | None = None, confirmed: int = 10**6
) -> Session:
    tagger = Tagger(RUN, 8, ClockFit(90_000_000, 0, 0))
    tagger.verify(tag_rows([LineTag(confirmed, 3 * confirmed, 2700 * confirmed)]))
    return Session(writer, tagger, np.zeros((7, WIDTH), np.uint16), first_line, lines)


steps = st.lists(st.tuples(st.integers(1, 40), st.booleans(), st.sampled_from(Cause)), max_size=30)


def stream(arm: str, steps: list[tuple[int, bool, Cause]]) -> Iterator[tuple[RingBlock, dict[int, Cause]]]:
    """Blocks as a grabber commits them, and the lines lost before each."""
    line, log, lost = 0, LossLog(), {}
    for count, arrives, cause in steps:
        if arrives:
            yield ring_block(arm, line, count, log.take()), lost
            lost = {}
        else:
            log.add(Loss(line, count, cause))
            lost |= dict.fromkeys(range(line, line + count), cause)
        line += count


@settings(deadline=None)
@given(a=steps, b=steps, first_line=st.integers(0, 100), lines=st.integers(1, 600))
def test_every_line_has_its_row_and_every_loss_its_cause(
    a: list[tuple[int, bool, Cause]], b: list[tuple[int, bool, Cause]], first_line: int, lines: int
) -> None:
    writer = MemoryWriter()
    session = make_session(writer, first_line, lines)
    expected: dict[str, dict[int, Cause]] = {}
    for arm, what in (("a", a), ("b", b)):
        expected[arm] = {}
        for block, lost in stream(arm, what):
            session.take(arm, block)
            expected[arm] |= lost
        reached = session.books[arm].next_line
        expected[arm] |= dict.fromkeys(range(reached, first_line + lines), Cause.STALLED)
        session.lost[arm] = Cause.STALLED
        session.give_up(arm)
    assert session.done
    sealed = session.close()
    for arm in ARMS:
        missing = {line: cause for line, cause in expected[arm].items() if 0 <= line - first_line < lines}
        pixels, flags = writer.column(arm, "pixels"), writer.column(arm, "flags")
        assert pixels.shape == (lines, WIDTH)
        for row, line in enumerate(range(first_line, first_line + lines)):
            assert (pixels[row] == (0 if line in missing else value_of(arm, line))).all()
            assert flags[row] == (LineFlag.MISSING if line in missing else 0)
        code_index = np.concatenate([block.tags.code_index for block in writer.blocks[arm]])
        assert np.array_equal(code_index, 3 * np.arange(first_line, first_line + lines))
        listed = {
            line: cause
            for gap_arm, first, count, cause in writer.gaps
            if gap_arm == arm
            for line in range(first, first + count)
        }
        assert listed.keys() == missing.keys()
        causes = {Cause(cause) for cause in listed.values()}
        if Cause.MIXED not in causes:
            assert listed == {line: str(cause) for line, cause in missing.items()}
        account = sealed.ledger[arm]
        assert account["balanced"]
        assert account["stored"] == lines - len(missing)
        assert sum(account["missing"].values()) == len(missing)
    whole = not any(account["missing"] for account in (sealed.ledger["a"], sealed.ledger["b"]))
    assert sealed.condition is (RunCondition.GOOD if whole else RunCondition.INCOMPLETE)
    assert writer.ending == (sealed.condition, "line budget reached", sealed.ledger)


@pytest.mark.parametrize(("other", "told"), [(Cause.ID_GAP, Cause.MIXED), (Cause.RING_FULL, Cause.RING_FULL)])
def test_more_losses_than_a_slot_can_tell_are_one_loss(other: Cause, told: Cause) -> None:
    """A full ring shows in it whatever else was lost: a recording ends there."""
    log = LossLog()
    for k in range(MAX_LOSSES + 5):
        log.add(Loss(10 * k, 10, Cause.CAMERA if k % 2 else other))
    losses = log.take()
    assert len(losses) == MAX_LOSSES
    assert losses[-1] == Loss(10 * (MAX_LOSSES - 1), 60, told)
    assert log.take() == ()


def feed(session: Session, end_a: int, end_b: int, flag: int = 0) -> None:
    session.take("a", ring_block("a", 0, end_a, flag=flag))
    session.take("b", ring_block("b", 0, end_b, flag=flag))


def test_stop_ends_at_a_line_that_both_reach() -> None:
    writer = MemoryWriter()
    session = make_session(writer)
    feed(session, 100, 80)
    session.end(90, "stopped")  # behind what is written already
    assert (session.end_line, session.done, session.ending) == (100, False, True)
    session.take("b", ring_block("b", 80, 40))
    assert session.done
    assert session.close().condition is RunCondition.GOOD
    assert writer.ending[1] == "stopped"
    assert writer.column("b", "pixels")[-1, 0] == value_of("b", 99)
    assert [event[0] for event in writer.events] == ["started", "stopped"]


def test_a_disk_that_is_nearly_full_ends_the_recording() -> None:
    writer = MemoryWriter()
    session = make_session(writer)
    session.take("a", ring_block("a", 0, 30, ()))
    session.take("b", ring_block("b", 0, 20, ()))
    session.commit()
    assert not session.ending
    writer.nearly_full = "disk nearly full"
    session.commit()
    assert (session.ending, session.done) == (True, False)
    session.take("b", ring_block("b", 20, 10, ()))
    assert session.done
    sealed = session.close()
    assert (sealed.condition, sealed.end_reason) == (RunCondition.INTERRUPTED, "disk nearly full")


def test_the_worst_reason_stays() -> None:
    session = make_session(MemoryWriter(), lines=1000)
    feed(session, 10, 10)
    session.end(500, "stopped")
    session.end(2000, "stopped again")
    assert session.end_reason == "stopped"
    session.end(400, "grabber b died", RunCondition.INTERRUPTED)
    session.end(400, "another reason", RunCondition.INCOMPLETE)
    session.lost = dict.fromkeys(ARMS, Cause.ARM_LOST)
    session.give_up("a")
    session.give_up("b")
    sealed = session.close()
    assert (sealed.condition, sealed.end_reason) == (RunCondition.INTERRUPTED, "grabber b died")
    assert sealed.ledger["pulses"] == 400


@pytest.mark.parametrize(
    ("flag", "confirmed", "condition", "count"),
    [
        (0, 10**6, RunCondition.GOOD, {}),
        (LineFlag.SATURATED, 10**6, RunCondition.GOOD, {"saturated": 50}),
        (LineFlag.INCOMPLETE, 10**6, RunCondition.TAINTED, {"incomplete": 50}),
        (0, 39, RunCondition.TAINTED, {"unverified": 10}),
    ],
)
def test_condition_follows_from_the_flags(
    flag: int, confirmed: int, condition: RunCondition, count: dict[str, int]
) -> None:
    session = make_session(MemoryWriter(), lines=50, confirmed=confirmed)
    feed(session, 50, 50, flag)
    sealed = session.close()
    assert sealed.condition is condition
    for name in ("saturated", "incomplete", "unverified"):
        assert sealed.ledger["a"][name] == count.get(name, 0)


def test_a_mismatch_of_tags_taints_and_is_listed_to_a_bound() -> None:
    writer = MemoryWriter()
    session = make_session(writer, lines=50)
    feed(session, 50, 50)
    wrong = Tagger(RUN, 8, ClockFit(90_000_000, 0, 0)).verify(
        tag_rows([LineTag(line, 1, 1) for line in range(2, 302)])
    )
    session.mismatches(wrong[:60])
    session.mismatches(wrong[60:])
    sealed = session.close()
    assert sealed.condition is RunCondition.TAINTED
    assert sealed.ledger["tag_mismatches"] == 300
    assert sum(kind == "tag_mismatch" for kind, _, _ in writer.events) == 100


def test_a_recording_without_a_line_is_not_good() -> None:
    session = make_session(MemoryWriter(), first_line=40)
    session.end(40, "stopped")
    sealed = session.close()
    assert (sealed.condition, sealed.ledger["pulses"]) == (RunCondition.INTERRUPTED, 0)


def test_take_says_how_many_lines_of_a_block_it_wrote() -> None:
    session = make_session(MemoryWriter(), first_line=10, lines=20)
    taken = [session.take("a", ring_block("a", first, count)) for first, count in ((0, 8), (8, 7), (20, 15))]
    assert taken == [0, 5, 10]
    assert session.take("a", ring_block("a", 35, 5)) == 0


def test_a_full_disk_aborts_and_seals_what_there_is() -> None:
    writer = MemoryWriter()
    session = make_session(writer, lines=50)
    feed(session, 20, 20)
    writer.broken, writer.kept_lines = ("append",), 20
    with pytest.raises(DataError) as failure:
        session.take("a", ring_block("a", 20, 20))
    sealed = session.close(failure.value)
    assert sealed.condition is RunCondition.ABORTED
    assert sealed.end_reason == "write error: append: no space left"
    assert sealed.ledger["a"] == sealed.ledger["b"] | {}
    assert sealed.ledger["a"]["stored"] == 20
    assert writer.ending[0] is RunCondition.ABORTED


def test_what_a_disk_that_failed_did_not_keep_is_not_in_the_books() -> None:
    """12 of the rows that were taken are kept; the others are left out, and so are their gaps."""
    writer = MemoryWriter(kept_lines=12)
    session = make_session(writer, lines=50)
    feed(session, 5, 5)
    for arm, lines in (("a", 5), ("b", 11)):  # lost before: lines 5 to 9, and 5 to 15
        session.take(arm, ring_block(arm, 5 + lines, 10, losses=(Loss(5, lines, Cause.RING_FULL),)))
    sealed = session.close(DataError("no space left"))
    assert sealed.ledger["pulses"] == 12
    assert sealed.ledger["a"]["stored"] == 5 + 2
    assert sealed.ledger["a"]["missing"] == {"ring_full": 5}
    assert sealed.ledger["b"]["stored"] == 5
    assert sealed.ledger["b"]["missing"] == {"ring_full": 7}
    assert session.left_out == {"a": 8, "b": 10}
    assert sealed.ledger["a"]["balanced"]
    assert sealed.ledger["b"]["balanced"]


def test_two_errors_of_a_disk_are_both_told_unless_they_are_the_same() -> None:
    def told(first: OSError, second: OSError) -> str:
        writer = MemoryWriter(broken=("seal",))
        error, writer.error = (
            DataError(f"committing: {first.strerror}"),
            DataError(f"sealing: {second.strerror}"),
        )
        error.__cause__, writer.error.__cause__ = first, second
        return make_session(writer, lines=50).close(error).end_reason

    gone, full = OSError(2, "No such file"), OSError(28, "No space left")
    assert told(gone, gone) == "write error: committing: No such file; nor could it be sealed"
    assert told(full, gone) == "write error: committing: No space left; not sealed: sealing: No such file"


def test_a_disk_that_does_not_even_seal_leaves_the_recording_as_committed() -> None:
    writer = MemoryWriter(broken=("seal",))
    session = make_session(writer, lines=50)
    feed(session, 50, 50)
    sealed = session.close()
    assert sealed.condition is RunCondition.ABORTED
    assert sealed.end_reason == "write error: seal: no space left; nor could it be sealed"
    assert writer.closed
    assert writer.ending is None
