"""The ring against a model, its refusal of torn reads, and the sudden death of a real producer."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from itertools import count

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from acquire.errors import DataError, UsageError
from acquire.stream.losses import MAX_LOSSES, Cause, Loss
from acquire.stream.ring import Ring, RingShape, RingStatistics

SHAPE = RingShape(slots=3, rows=4, width=5, dtype="uint16")


def pattern(first_line: int, lines: int, width: int) -> np.ndarray:
    """Pixels that tell their line and place."""
    line = np.arange(first_line, first_line + lines)[:, None]
    return ((line * 31 + np.arange(width)) % 60_000).astype(np.uint16)


class RingMachine(RuleBasedStateMachine):
    """Commits, drops, reads and releases in any order, against a queue."""

    def __init__(self) -> None:
        super().__init__()
        self.ring = Ring("model", SHAPE)
        self.queue: deque[tuple[int, int, tuple[Loss, ...]]] = deque()
        self.line = self.peak = self.dropped_blocks = self.dropped_lines = self.newest = 0

    def teardown(self) -> None:
        self.ring.close()

    @rule(
        lines=st.integers(1, SHAPE.rows),
        losses=st.lists(
            st.builds(Loss, st.integers(0, 2**40), st.integers(1, 99), st.sampled_from(Cause)),
            max_size=MAX_LOSSES,
        ),
    )
    def produce(self, lines: int, losses: list[Loss]) -> None:
        slot = self.ring.claim()
        assert (slot is None) == (len(self.queue) == SHAPE.slots)
        if slot is None:
            self.ring.drop(lines)
            self.dropped_blocks += 1
            self.dropped_lines += lines
        else:
            slot.pixels[:lines] = pattern(self.line, lines, SHAPE.width)
            slot.flags[:lines] = np.arange(lines)
            self.ring.commit(self.line, lines, losses)
            self.queue.append((self.line, lines, tuple(losses)))
            self.peak = max(self.peak, len(self.queue))
            self.newest = self.line + lines
        self.line += lines

    @rule()
    def claim_and_think_better_of_it(self) -> None:
        self.ring.claim()

    @rule()
    def look(self) -> None:
        block = self.ring.acquire()
        assert (block is None) == (not self.queue)
        if block is not None:
            first, lines, losses = self.queue[0]
            assert (block.first_line, block.end_line, block.losses) == (first, first + lines, losses)
            assert np.array_equal(block.pixels, pattern(first, lines, SHAPE.width))
            assert block.flags.tolist() == list(range(lines))

    @precondition(lambda self: self.queue)
    @rule()
    def release(self) -> None:
        assert self.ring.acquire() is not None
        self.ring.release()
        self.queue.popleft()

    @precondition(lambda self: not self.queue)
    @rule()
    def release_nothing(self) -> None:
        with pytest.raises(DataError, match="torn or stale"):
            self.ring.release()

    @invariant()
    def statistics_tell(self) -> None:
        assert self.ring.statistics() == RingStatistics(
            SHAPE.slots, len(self.queue), self.peak, self.dropped_blocks, self.dropped_lines
        )
        assert self.ring.newest_line == self.newest


TestRingMachine = RingMachine.TestCase
TestRingMachine.settings = settings(max_examples=100, stateful_step_count=40, deadline=None)


@pytest.fixture
def ring() -> Ring:
    made = Ring("test", SHAPE)
    yield made
    made.close()


def test_a_slot_overwritten_while_it_is_read_is_refused(ring: Ring) -> None:
    for line in range(SHAPE.slots):
        ring.claim()
        ring.commit(line, 1)
    assert ring.acquire() is not None
    ring._control[8] = 1  # a consumer that let go too early: the producer takes the slot again
    assert ring.claim() is not None
    ring._control[8] = 0
    with pytest.raises(DataError, match="torn or stale"):
        ring.release()
    with pytest.raises(DataError, match="torn or stale"):
        ring.acquire()


def test_a_wait_is_bounded_and_ends_with_a_commit(ring: Ring) -> None:
    begun = time.monotonic()
    assert ring.acquire(0.05) is None
    assert 0.05 <= time.monotonic() - begun < 2
    ring.claim()
    later = threading.Timer(0.05, ring.commit, (7, 2))
    later.start()
    block = ring.acquire(10)
    later.join()
    assert block is not None
    assert block.first_line == 7
    assert time.monotonic() - begun < 5


def test_doorbell_rings_until_hushed(ring: Ring) -> None:
    ring.claim()
    ring.commit(0, 1)
    ring.hush()
    with pytest.raises(BlockingIOError):
        os.eventfd_read(ring.fileno())
    ring.hush()  # nothing to hush
    assert ring.acquire() is not None  # what was committed does not depend on the bell


def test_impossible_shapes_and_losses_are_refused(ring: Ring) -> None:
    with pytest.raises(UsageError, match="0 slots"):
        RingShape(0, 1, 1, "uint8")
    ring.claim()
    with pytest.raises(UsageError, match="losses"):
        ring.commit(0, 1, [Loss(0, 1, Cause.CAMERA)] * (MAX_LOSSES + 1))


BIG = RingShape(slots=4, rows=256, width=64, dtype="uint16")


def produce_for_ever(ring: Ring) -> None:
    """A producer in a process of its own, as fast as it can."""
    line = 0
    while True:
        slot = ring.claim()
        if slot is not None:
            slot.pixels[:] = pattern(line, BIG.rows, BIG.width)
            slot.flags[:] = line % 1000
            ring.commit(line, BIG.rows)
            line += BIG.rows


def test_producer_killed_in_mid_stream_leaves_whole_blocks_only() -> None:
    ring = Ring("killed", BIG)
    process = multiprocessing.get_context("spawn").Process(target=produce_for_ever, args=(ring,))
    process.start()
    try:
        for number in count():
            block = ring.acquire(20 if number == 0 else 0.2)
            if block is None:
                break
            assert block.first_line == number * BIG.rows
            assert np.array_equal(block.pixels, pattern(block.first_line, BIG.rows, BIG.width))
            assert (block.flags == block.first_line % 1000).all()
            ring.release()
            del block
            if number == 200:
                assert process.pid is not None
                os.kill(process.pid, signal.SIGKILL)
        assert number > 200
    finally:
        process.kill()
        process.join(10)
        process.close()
        ring.close()
