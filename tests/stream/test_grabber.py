"""From camera blocks to ring slots, in one process."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.camera.base import CameraBlock
from acquire.errors import CameraError
from acquire.lines import LineFlag
from acquire.processes.shared import Counters
from acquire.stream.grabber import COUNTERS, GrabberPlan, Intake
from acquire.stream.losses import Cause, Loss
from acquire.stream.ring import Ring, RingBlock, RingShape

DEPTH, WHITE, MOST_LOST = 9, 4000, 100_000
SHAPE = RingShape(slots=4, rows=16, width=3, dtype="uint16")


class Path:
    """One intake, its ring and its counters."""

    def __init__(self) -> None:
        self.ring = Ring("test", SHAPE)
        self.counters = Counters(COUNTERS)
        self.intake = Intake(
            GrabberPlan("a", lambda: None, DEPTH, WHITE, MOST_LOST), self.ring, self.counters
        )

    def give(self, first: int, count: int, width: int = 3, dtype: str = "uint16") -> None:
        line = np.arange(first, first + count)[:, None] - DEPTH
        pixels = ((line + np.arange(width)) % WHITE).astype(dtype)
        self.intake.take(CameraBlock(first, pixels, np.zeros(count, np.uint16)))

    def taken(self) -> list[tuple[int, int, tuple[Loss, ...]]]:
        """What is in the ring, checked and released."""
        found = []
        while (block := self.ring.acquire()) is not None:
            check_pixels(block)
            found.append((block.first_line, block.end_line, block.losses))
            self.ring.release()
        return found

    def counts(self) -> tuple[int, ...]:
        return tuple(self.counters[name] for name in ("delivered", "preroll", "camera"))

    def close(self) -> None:
        self.ring.close()
        self.counters.close()


def check_pixels(block: RingBlock) -> None:
    line = np.arange(block.first_line, block.end_line)[:, None]
    assert np.array_equal(block.pixels, (line + np.arange(3)) % WHITE)


@pytest.fixture
def path() -> Iterator[Path]:
    made = Path()
    yield made
    made.close()


def test_preroll_is_discarded_and_long_blocks_are_split(path: Path) -> None:
    path.give(0, 5)
    path.give(5, 40)
    assert path.taken() == [(0, 16, ()), (16, 32, ()), (32, 36, ())]
    assert path.counts() == (45, 9, 0)


def test_a_jump_of_the_camera_s_count_is_located(path: Path) -> None:
    path.give(0, 20)
    path.give(30, 10)
    assert path.taken() == [(0, 11, ()), (21, 31, (Loss(11, 10, Cause.CAMERA),))]
    assert path.counts() == (30, 9, 10)


def test_a_jump_inside_the_preroll_loses_nothing(path: Path) -> None:
    path.give(3, 4)
    path.give(12, 8)
    assert path.taken() == [(3, 11, (Loss(0, 3, Cause.CAMERA),))]
    assert path.counts() == (12, 4, 3)


def test_a_full_ring_loses_located_lines(path: Path) -> None:
    path.give(0, DEPTH)
    for k in range(6):
        path.give(DEPTH + 10 * k, 10)
    path.give(DEPTH + 65, 10)
    assert path.ring.statistics().dropped_lines == 30
    assert [block[:2] for block in path.taken()] == [(0, 10), (10, 20), (20, 30), (30, 40)]
    path.give(DEPTH + 75, 2)
    losses = (Loss(40, 20, Cause.RING_FULL), Loss(60, 5, Cause.CAMERA), Loss(65, 10, Cause.RING_FULL))
    assert path.taken() == [(75, 77, losses)]


def test_white_pixels_flag_their_lines(path: Path) -> None:
    pixels = np.zeros((DEPTH + 6, 3), np.uint16)
    pixels[DEPTH + 2, 1], pixels[DEPTH + 4, 0] = WHITE, WHITE
    flags = np.full(len(pixels), LineFlag.INCOMPLETE, np.uint16)
    path.intake.take(CameraBlock(0, pixels, flags))
    block = path.ring.acquire()
    assert block is not None
    saturated = LineFlag.INCOMPLETE | LineFlag.SATURATED
    assert block.flags.tolist() == [2, 2, saturated, 2, saturated, 2]
    assert (flags == LineFlag.INCOMPLETE).all()


@pytest.mark.parametrize("first", [19, 20 + MOST_LOST + 1])
def test_a_count_that_cannot_be_is_refused(path: Path, first: int) -> None:
    path.give(0, 20)
    with pytest.raises(CameraError, match=f"went from 20 to {first}"):
        path.give(first, 10)


@pytest.mark.parametrize(("width", "dtype"), [(4, "uint16"), (3, "uint8")])
def test_blocks_of_another_shape_or_type_are_refused(path: Path, width: int, dtype: str) -> None:
    with pytest.raises(CameraError, match="a block of"):
        path.give(0, 20, width, dtype)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.integers(1, 50), st.sampled_from(["come", "lost", "read"])), max_size=40))
def test_lines_are_preroll_or_in_the_ring_or_located_losses(steps: list[tuple[int, str]]) -> None:
    path = Path()
    line, come, seen, located = 0, 0, 0, 0
    for count, what in [*steps, (1, "read"), (1, "come"), (1, "read")]:
        if what == "read":
            for first, end, losses in path.taken():
                seen += end - first
                located += sum(loss.count for loss in losses)
                assert not losses or losses[-1].end_line == first
        else:
            line += count
            if what == "come":
                path.give(line - count, count)
                come += count
    delivered, preroll, camera_lost = path.counts()
    dropped = path.ring.statistics().dropped_lines
    assert delivered == come
    assert come == preroll + seen + dropped
    assert located == camera_lost + dropped
    assert located + seen == max(0, line - DEPTH)
    path.close()
