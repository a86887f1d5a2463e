"""The recorder's loop in this process, turn by turn, with a disk that takes as long as the test says."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from wired_devices import CODE, PIXELS, STAGES, SUBSTEP_TICKS, SUBSTEPS, make_spec

from acquire.clock import ClockFit
from acquire.errors import DataError
from acquire.lines import ARMS
from acquire.store import RunCondition, Suspect, open_recording, suspect_lines
from acquire.store.suspect import DOUBTFUL, VERIFIED
from acquire.stream.messages import Began, Begin, End, Note, Refused, RunStarted, Sealed
from acquire.stream.recorder import COUNTERS, Recorder, RecorderPlan
from acquire.stream.ring import Ring, RingShape
from acquire.stream.shared import Counters
from acquire.stream.witness import Witness
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


def deliver(ring: Ring, line: int) -> None:
    slot = ring.claim()
    assert slot is not None, "the recorder does not empty the ring"
    slot.pixels[:] = np.arange(line, line + ROWS)[:, None]
    slot.flags[:] = 0
    ring.commit(line, ROWS)


class Bed:
    def __init__(self) -> None:
        self.rings = {arm: Ring(arm, RingShape(SLOTS, ROWS, PIXELS, "uint16")) for arm in ARMS}
        self.tags = Ring("tags", RingShape(4, 16, 3, "uint64"))
        self.counters = Counters(COUNTERS)
        self.post = Post()
        self.disk = SlowDisk()
        plan = RecorderPlan(RUN, STAGES, stall_timeout_s=60.0, tag_wait_s=0.0, max_skew_lines=10_000)
        self.recorder = Recorder(
            self.post, plan, self.rings, self.tags, self.counters, self.disk, Witness({})
        )
        self.post.waiting.append(RunStarted(ClockFit(90_000_000, 0, 0)))
        self.line = 0

    def lines(self, blocks: int = 1) -> None:
        """The cameras deliver, and the recorder has a turn after each block."""
        for _ in range(blocks):
            for ring in self.rings.values():
                deliver(ring, self.line)
            self.line += ROWS
            self.recorder.turn()

    def close(self) -> None:
        for ring in (*self.rings.values(), self.tags):
            ring.close()
        self.counters.close()
        self.post.close()


@pytest.fixture
def bed() -> Iterator[Bed]:
    made = Bed()
    yield made
    made.close()


def test_lines_are_discarded_until_the_recording_can_take_them(bed: Bed, tmp_path: Path) -> None:
    bed.lines(3)
    bed.post.waiting.append(Begin(tmp_path / "r.zarr", make_spec(), None))
    bed.lines(10 * SLOTS)  # many times what the ring holds
    assert bed.post.said == []
    bed.disk.finish()
    first_line = bed.line
    bed.lines(5)
    # The turn that finds the recording ready has met the block that came before it.
    assert bed.post.said == [Began(first_line + ROWS)]
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
    assert isinstance(refused.error, DataError)
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
