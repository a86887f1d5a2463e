"""Frames to blocks: what waits for its place is bounded, and nothing is counted twice or not at all."""

from __future__ import annotations

import numpy as np

from acquire.camera.assembly import Assembly, Frame, FrameFormat
from acquire.camera.base import CameraBlock, CameraLoss, LossCause
from acquire.camera.frames import FrameFacts
from acquire.camera.pixels import layout_of
from acquire.camera.spec import GenicamSpec
from acquire.lines import LineFlag

HEIGHT, WIDTH, BUFFERS = 4, 6, 16


def frame(number: int | None, filled: int = HEIGHT * WIDTH, complete: bool | None = None) -> Frame:
    memory = np.full(HEIGHT * WIDTH, number or 0, np.uint8)
    whole = number is not None if complete is None else complete
    return Frame(object(), memory, filled, FrameFacts(number), whole)


def assembly() -> Assembly:
    return Assembly(FrameFormat(WIDTH, HEIGHT, layout_of("Mono8")), GenicamSpec("x"), BUFFERS)


def ready(taker: Assembly) -> list[CameraBlock]:
    """Take all blocks that have their place."""
    return list(iter(taker.next_block, None))


def test_frames_without_a_number_wait_for_the_next_and_come_flagged_before_it() -> None:
    taker = assembly()
    assert taker.take(frame(1)) == []
    assert [block.first_line for block in ready(taker)] == [0]
    between = [frame(None), frame(None)]
    assert [taker.take(waiting) for waiting in between] == [[], []]
    assert ready(taker) == []
    after = frame(4)
    assert taker.take(after) == []
    blocks = ready(taker)
    assert [taker.release(block) for block in blocks] == [f.buffer for f in (*between, after)]
    assert [block.first_line for block in blocks] == [4, 8, 12]
    assert [int(block.flags[0]) for block in blocks] == [LineFlag.INCOMPLETE, LineFlag.INCOMPLETE, 0]
    assert all(not block.losses for block in blocks)


def test_a_camera_that_delivers_only_broken_frames_keeps_few_buffers_and_they_are_lost() -> None:
    taker = assembly()
    taker.take(frame(1))
    ready(taker)
    waiting = [frame(None) for _ in range(100)]
    given_back = [buffer for each in waiting for buffer in taker.take(each)]
    free = taker.take(frame(102))
    assert {*given_back, *free} == {each.buffer for each in waiting}
    assert len(given_back) >= 100 - BUFFERS // 4
    (block,) = ready(taker)
    assert (block.first_line, block.losses) == (
        101 * HEIGHT,
        (CameraLoss(LossCause.INCOMPLETE, 100 * HEIGHT),),
    )


def test_a_frame_without_a_line_is_lost_and_its_buffer_is_free() -> None:
    taker = assembly()
    taker.take(frame(1))
    ready(taker)
    empty = frame(2, filled=0, complete=False)
    assert taker.take(empty) == [empty.buffer]
    short = frame(3, filled=WIDTH + 1, complete=False)
    assert taker.take(short) == []
    (block,) = ready(taker)
    assert (block.first_line, len(block.flags)) == (2 * HEIGHT, 1)
    assert block.losses == (CameraLoss(LossCause.INCOMPLETE, HEIGHT),)
    taker.take(frame(4))
    (block,) = ready(taker)
    assert block.losses == (CameraLoss(LossCause.INCOMPLETE, HEIGHT - 1),)


def test_a_late_frame_gives_its_buffer_back_and_is_counted() -> None:
    taker = assembly()
    taker.take(frame(10))
    late = frame(9)
    assert taker.take(late) == [late.buffer]
    assert taker.statistics()["stale_frames"] == 1


def test_a_buffer_is_lent_with_its_block_and_given_back_once() -> None:
    taker = assembly()
    whole = frame(1)
    taker.take(whole)
    assert taker.statistics()["lines"] == 0  # ready, but not delivered
    (block,) = ready(taker)
    assert taker.statistics()["lines"] == HEIGHT
    assert [taker.release(block), taker.release(block)] == [whole.buffer, None]


def test_a_stopped_acquisition_has_neither_blocks_nor_buffers_but_its_statistics() -> None:
    taker = assembly()
    taker.take(frame(1))
    (lent,) = ready(taker)
    taker.take(frame(2))
    taker.forget_buffers()
    assert (ready(taker), taker.release(lent)) == ([], None)
    assert taker.statistics()["lines"] == HEIGHT
