"""The recorder's loop in this process, turn by turn, with a disk that takes as long as the test says."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from wired_devices import CODE, PIXELS, STAGES, SUBSTEP_TICKS, SUBSTEPS, make_spec

from acquire.clock import ClockFit
from acquire.errors import StateError, StoreError
from acquire.lines import ARMS
from acquire.processes.shared import Counters
from acquire.store import RunCondition, Suspect, open_recording, suspect_lines
from acquire.store.mount import mount_above
from acquire.store.suspect import DOUBTFUL, VERIFIED
from acquire.stream import recorder_states
from acquire.stream.external_counts import ExternalCounts
from acquire.stream.losses import Cause, Loss, LossLog
from acquire.stream.messages import Began, Begin, Cancel, End, Extend, Note, Refused, RunStarted, Sealed
from acquire.stream.recorder import Recorder
from acquire.stream.recorder_plan import COUNTERS, RecorderPlan
from acquire.stream.recorder_states import RecorderEvent, RecorderState
from acquire.stream.ring import Ring, RingShape
from acquire.stream.stalls import find_stall
from acquire.stream.window import NOW, Window
from acquire.trigger.base import TriggerRun

ROWS, SLOTS = 16, 4
RUN = TriggerRun("r", CODE, SUBSTEPS, SUBSTEP_TICKS, ROWS)


class Post:
    """The recorder's mailbox: what it will find, and what it said."""

    def __init__(self) -> None:
        self.waiting: list[object] = []
        self.said: list[object] = []
        self._bell = os.eventfd(0)

    def take(self) -> object | None:
        return self.waiting.pop(0) if self.waiting else None

    def post(self, message: object) -> None:
        self.said.append(message)

    def fileno(self) -> int:
        return self._bell

    def close(self) -> None:
        os.close(self._bell)


class SlowDisk:
    """An executor that works when it is told to."""

    def __init__(self) -> None:
        self.work: list[tuple[Future[Any], Callable[[], Any]]] = []

    def submit(self, target: Callable[..., Any], *args: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.work.append((future, lambda: target(*args)))
        return future

    def finish(self, error: Exception | None = None) -> None:
        future, target = self.work.pop(0)
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(target())


class Bed:
    """A recorder between rings that the test fills and a disk that the test moves."""

    stall_timeout_s = 60.0

    def __init__(self) -> None:
        self.losses = {arm: LossLog() for arm in ARMS}
        self.rings = {arm: Ring(arm, RingShape(SLOTS, ROWS, PIXELS, "uint16")) for arm in ARMS}
        self.tags = Ring("tags", RingShape(4, 16, 3, "uint64"))
        self.counters = Counters(COUNTERS)
        self.post = Post()
        self.disk = SlowDisk()
        plan = RecorderPlan(
            RUN, STAGES, stall_timeout_s=self.stall_timeout_s, tag_wait_s=0.0, max_skew_lines=10_000
        )
        self.recorder = Recorder(
            self.post,
            plan,
            self.rings,
            tags=self.tags,
            counters=self.counters,
            disk=self.disk,
            external=ExternalCounts({}),
        )
        self.post.waiting.append(RunStarted(ClockFit(90_000_000, 0, 0)))
        self.line = 0

    def lines(self, blocks: int = 1) -> None:
        """The cameras deliver, and the recorder has a turn after each block."""
        for _ in range(blocks):
            for arm, ring in self.rings.items():
                assert ring.fill < SLOTS, "the recorder does not empty the ring"
                self.offer(arm, self.line)
            self.line += ROWS
            self.recorder.turn()

    def offer(self, arm: str, line: int) -> None:
        """The camera's lines come while the recorder is held up, and may find the ring full."""
        ring = self.rings[arm]
        slot = ring.claim(line, ROWS)
        if slot is None:
            ring.drop(line, ROWS)
            self.losses[arm].add(Loss(line, ROWS, Cause.RING_FULL))
            return
        slot.pixels[:] = np.arange(line, line + ROWS)[:, None]
        slot.flags[:] = 0
        ring.commit(slot, self.losses[arm].take())

    def begin(self, path: Path, window: Window = NOW) -> int:
        """A recording without an end; its first line."""
        self.lines()
        self.post.waiting.append(Begin(path, make_spec(), None, window))
        self.lines()
        self.disk.finish()
        self.lines()
        began = self.post.said.pop()
        assert isinstance(began, Began)
        return began.first_line

    def sealed(self) -> Sealed:
        self.recorder.turn()
        self.disk.finish()
        self.recorder.turn()
        sealed = self.post.said.pop()
        assert isinstance(sealed, Sealed)
        return sealed

    def close(self) -> None:
        for ring in (*self.rings.values(), self.tags):
            ring.close()
        self.counters.close()
        self.post.close()


@pytest.fixture
def bed(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bed]:
    # A turn takes the blocks that are there, however long a busy machine keeps the test waiting in it.
    monkeypatch.setattr("acquire.stream.recorder._LONGEST_DRAIN_S", 60.0)
    made = Bed()
    yield made
    made.close()


COMMANDS = ("start", "cancel", "stop", "extend")
STATES = {
    # state → how the recorder comes there, and where each of the owner's commands leads; "": it is refused
    RecorderState.WAITING: ((), {"start": "", "cancel": "waiting", "stop": "waiting", "extend": "waiting"}),
    RecorderState.DISCARDING: (
        ("run",),
        {"start": "opening", "cancel": "discarding", "stop": "discarding", "extend": "discarding"},
    ),
    RecorderState.OPENING: (
        ("run", "start"),
        {"start": "", "cancel": "cancelled", "stop": "opening", "extend": "opening"},
    ),
    RecorderState.CANCELLED: (
        ("run", "start", "cancel"),
        {"start": "", "cancel": "cancelled", "stop": "cancelled", "extend": "cancelled"},
    ),
    RecorderState.RECORDING: (
        ("run", "start", "disk"),
        {"start": "", "cancel": "sealing", "stop": "sealing", "extend": "recording"},
    ),
    RecorderState.SEALING: (
        ("run", "start", "disk", "stop"),
        {"start": "", "cancel": "sealing", "stop": "sealing", "extend": "sealing"},
    ),
}


@pytest.mark.parametrize(("state", "command"), [*itertools.product(STATES, COMMANDS)])
def test_every_command_in_every_state(bed: Bed, tmp_path: Path, state: RecorderState, command: str) -> None:
    """A command that makes no sense is refused in words, one that crossed with an end changes nothing."""
    bed.post.waiting.clear()
    messages = {
        "run": RunStarted(ClockFit(90_000_000, 0, 0)),
        "start": Begin(tmp_path / "r.zarr", make_spec(), None),
        "cancel": Cancel(),
        "stop": End("stopped", 0),
        "extend": Extend(10),
    }

    def happen(what: str) -> str:
        if what == "disk":
            bed.disk.finish()
        else:
            bed.post.waiting.append(messages[what])
        bed.recorder.turn()
        return recorder_states.STATES[bed.counters["state"]]

    way, leads = STATES[state]
    for what in way:
        happen(what)
    assert recorder_states.STATES[bed.counters["state"]] is state
    bed.post.said.clear()
    found = happen(command)
    if leads[command]:
        assert found == leads[command]
        assert bed.post.said == []
    else:
        assert found is state
        (refused,) = bed.post.said
        assert isinstance(refused, Refused)
        assert recorder_states.MEANINGS[state] in refused.error.message
    for _ in range(2):  # whatever it was, it can be brought to its end
        if bed.disk.work:
            happen("disk")
        happen("stop")
    assert recorder_states.STATES[bed.counters["state"]] in ("waiting", "discarding", "sealing")
    if bed.disk.work:
        assert happen("disk") == "discarding"


@pytest.mark.parametrize(("state", "event"), [*itertools.product(RecorderState, RecorderEvent)])
def test_the_table_refuses_what_has_no_row_in_the_words_of_the_state(
    state: RecorderState, event: RecorderEvent
) -> None:
    if (state, event) in recorder_states.TABLE:
        assert recorder_states.after(state, event) is recorder_states.TABLE[state, event]
        return
    with pytest.raises(StateError) as caught:
        recorder_states.after(state, event)
    assert caught.value.message == f"{event}: {recorder_states.MEANINGS[state]}"


def test_lines_are_discarded_until_the_recording_can_take_them(bed: Bed, tmp_path: Path) -> None:
    bed.lines(3)
    bed.post.waiting.append(Begin(tmp_path / "r.zarr", make_spec(), None))
    bed.lines(10 * SLOTS)  # many times what the ring holds
    assert bed.post.said == []
    bed.disk.finish()
    first_line = bed.line
    bed.lines(5)
    # The turn that finds the recording ready has met the block that came before it.
    assert bed.post.said == [Began(first_line + ROWS, mount=mount_above(tmp_path))]
    bed.post.waiting.append(End("stopped"))
    bed.recorder.turn()
    bed.disk.finish()
    bed.recorder.turn()
    (sealed,) = bed.post.said[1:]
    assert isinstance(sealed, Sealed)
    assert sealed.ledger["a"]["stored"] == 4 * ROWS
    assert bed.counters["discarded_a"] == bed.counters["discarded_b"] == first_line + ROWS
    recording = open_recording(tmp_path / "r.zarr")
    assert (recording.first_line, recording.lines) == (first_line + ROWS, 4 * ROWS)
    assert recording.camera("b").lines[:, 0].tolist() == list(range(first_line + ROWS, bed.line))


@pytest.mark.parametrize(
    "error", [OSError(36, "File name too long"), ValueError("embedded null byte"), MemoryError()]
)
def test_whatever_keeps_a_recording_from_being_made_refuses_it(
    bed: Bed, tmp_path: Path, error: Exception
) -> None:
    bed.lines()
    bed.post.waiting.append(Begin(tmp_path / "r.zarr", make_spec(), 32))
    bed.lines()
    bed.disk.finish(error)
    bed.lines()
    (refused,) = bed.post.said
    assert isinstance(refused, Refused)
    assert isinstance(refused.error, StoreError)
    assert repr(error) in str(refused.error)
    bed.post.waiting.append(Begin(tmp_path / "r.zarr", make_spec(), 32))
    bed.lines()
    bed.disk.finish()
    bed.lines(4)
    bed.disk.finish()
    bed.recorder.turn()
    assert isinstance(bed.post.said[-1], Sealed)
    assert bed.post.said[-1].condition in (RunCondition.GOOD, RunCondition.TAINTED)


def test_every_turn_is_a_sign_of_life(bed: Bed) -> None:
    before = bed.counters["turns"]
    for _ in range(3):
        bed.recorder.turn()
    assert bed.counters["turns"] == before + 3


def record_with_verdicts(bed: Bed, path: Path, *before: Note) -> tuple[Suspect, ...]:
    """100 lines from 4 blocks on; ``before``: what the watcher said before; then arm a slips."""
    bed.lines(3)
    bed.post.waiting += [*before, Begin(path, make_spec(), None)]
    bed.lines()
    bed.disk.finish()
    bed.lines(3)
    bed.post.waiting.append(Note(bed.line - 20, DOUBTFUL["a"], "inverted"))
    bed.lines(3)
    bed.post.waiting += [Note(bed.line - 10, VERIFIED["a"], "verified"), End("stopped")]
    bed.recorder.turn()
    bed.disk.finish()
    bed.recorder.turn()
    return suspect_lines(open_recording(path))


def test_a_verdict_that_comes_late_says_where_it_begins(bed: Bed, tmp_path: Path) -> None:
    """Of what was said before the recording, what still holds at its first line is in it."""
    said = [
        Note(0, DOUBTFUL["a"], "dark"),
        Note(16, DOUBTFUL["b"], "dark"),
        Note(32, VERIFIED["a"], "verified"),
    ]
    found = record_with_verdicts(bed, tmp_path / "r.zarr", *said)
    recording = open_recording(tmp_path / "r.zarr")
    first, end = recording.first_line, recording.first_line + recording.lines
    slip = 7 * ROWS - 20
    assert first < slip < bed.line - 10 < end
    assert found == (
        Suspect("a", slip, bed.line - 10 - slip, "inverted"),
        Suspect("b", first, end - first, "dark"),
    )


@pytest.mark.parametrize(("late", "other"), [("a", "b"), ("b", "a")])
def test_a_ring_that_overflows_ends_the_recording_before_the_line(
    bed: Bed, tmp_path: Path, late: str, other: str
) -> None:
    """The other arm is past the line before that is seen: the recording has what both have, and no gap."""
    first_line = bed.begin(tmp_path / "r.zarr")
    for k in range(SLOTS + 2):
        bed.offer(late, bed.line + k * ROWS)
    full_at = bed.line + SLOTS * ROWS
    for k in range(SLOTS + 2):
        bed.offer(other, bed.line + k * ROWS)
        bed.recorder.turn()
    bed.offer(late, full_at + 2 * ROWS)
    sealed = bed.sealed()
    assert sealed.condition is RunCondition.INTERRUPTED
    assert sealed.end_reason == f"too slow to write: the ring of arm {late} was full at line {full_at}"
    recording = open_recording(tmp_path / "r.zarr")
    assert not recording.gaps
    assert (recording.first_line, recording.lines) == (first_line, full_at - first_line)
    for arm in ARMS:
        book = sealed.ledger[arm]
        assert (book["stored"], book["missing"], book["balanced"]) == (recording.lines, {}, True)
        assert (bed.counters[f"stored_{arm}"], bed.counters[f"overrun_{arm}"]) == (recording.lines, 0)
        assert recording.camera(arm).lines[:, 0].tolist() == list(range(first_line, full_at))
    assert bed.counters[f"discarded_{other}"] == first_line + 2 * ROWS


def test_a_recorder_that_is_stopped_does_not_take_its_own_pause_for_the_arms_silence(
    bed: Bed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even if it is stopped after its last look at the rings, right before it judges the arms."""
    bed.begin(tmp_path / "r.zarr")
    pause_s = bed.stall_timeout_s + 1.0

    def stopped(*args: Any) -> Any:
        monkeypatch.setattr("time.monotonic", lambda now=time.monotonic: now() + pause_s)
        for arm in ARMS:
            bed.offer(arm, bed.line)
        return find_stall(*args)

    monkeypatch.setattr("acquire.stream.recorder.find_stall", stopped)
    bed.recorder.turn()
    monkeypatch.setattr("acquire.stream.recorder.find_stall", find_stall)
    bed.line += ROWS
    bed.lines()
    bed.post.waiting.append(End("stopped", bed.line))
    assert bed.sealed().end_reason == "stopped"


def test_a_recording_begins_after_what_found_the_rings_full(bed: Bed, tmp_path: Path) -> None:
    """It would begin with what was: the lines that were dropped are no part of it."""
    bed.lines()
    for k in range(2 * SLOTS):
        for arm in ARMS:
            bed.offer(arm, bed.line + k * ROWS)
    dropped_end = bed.line = bed.line + 2 * SLOTS * ROWS
    bed.recorder.turn()
    first_line = bed.begin(tmp_path / "r.zarr", Window(pre_lines=10**6, exact=False))
    assert first_line == dropped_end
    bed.post.waiting.append(End("stopped"))
    assert bed.sealed().condition is not RunCondition.INTERRUPTED
    assert open_recording(tmp_path / "r.zarr").lines > 0


def test_a_recording_waits_for_rings_that_are_about_to_overflow(bed: Bed, tmp_path: Path) -> None:
    bed.lines(3)
    bed.post.waiting.append(Begin(tmp_path / "r.zarr", make_spec(), None))
    bed.recorder.turn()
    bed.disk.finish()
    for k in range(SLOTS + 1):
        for arm in ARMS:
            bed.offer(arm, bed.line + k * ROWS)
    bed.recorder.turn()
    assert bed.post.said == []
    bed.recorder.turn()
    assert bed.post.said == [Began(bed.line + (SLOTS + 1) * ROWS, mount=mount_above(tmp_path))]
    bed.post.waiting.append(End("stopped"))
    assert bed.sealed().ledger["a"]["missing"] == {}


def test_what_found_no_slot_without_a_recorder_is_a_gap_and_counted_once(bed: Bed, tmp_path: Path) -> None:
    """A recorder that takes another's place reads the same block again, should it be killed as well."""
    bed.lines(3)
    at = bed.line
    for k in range(SLOTS + 2):
        for arm in ARMS:
            bed.offer(arm, at + k * ROWS)
    for arm in ARMS:
        assert bed.rings[arm].dropped_end == at + (SLOTS + 2) * ROWS
    bed.counters["overrun_to_b"] = at + (SLOTS + 1) * ROWS  # as the one before had counted
    bed.counters["overrun_b"] = ROWS
    bed.post.waiting.append(
        Begin(tmp_path / "r.zarr", make_spec(), None, Window(at, exact=False, padded=True))
    )
    bed.recorder.turn()
    bed.disk.finish()
    bed.recorder.turn()
    bed.line = at + (SLOTS + 2) * ROWS
    for arm in ARMS:
        bed.offer(arm, bed.line)
    bed.recorder.turn()
    bed.recorder.turn()
    bed.post.waiting.append(End("stopped"))
    sealed = bed.sealed()
    assert sealed.condition is RunCondition.INCOMPLETE
    for arm in ARMS:
        assert sealed.ledger[arm]["missing"] == {"ring_full": 2 * ROWS}
        assert bed.counters[f"overrun_{arm}"] == 2 * ROWS
    assert {(gap.first_line, gap.count) for gap in open_recording(tmp_path / "r.zarr").gaps} == {
        (at + SLOTS * ROWS, 2 * ROWS)
    }
