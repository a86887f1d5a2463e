"""Disks that are too slow, full, broken or read-only, under the real recorder process.

Whatever the disk does: what is acknowledged can be read, the recording ends with a reason, and every line of
it is there or listed. A slow disk ends it before a line is lost.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from slow_disks import FailingDisk, SlowDisk
from throttle import Throttle
from waiting import until

from acquire.capacity.load import CLOCK_HZ, Load, recording_spec
from acquire.capacity.run import capture_plan
from acquire.config.device import TriggerConfig
from acquire.flags import ARMS, LineFlag
from acquire.pattern import Pattern
from acquire.sim.clock import Wire
from acquire.sim.trigger_model import TriggerModel
from acquire.sim.twin_links import TwinTransport
from acquire.store import open_recording, verify
from acquire.store.files import DISK, Disk
from acquire.stream import Begin, Capture, CaptureStatus
from acquire.stream.lifecycle import MEANINGS, Stage
from acquire.stream.stalls import NEARLY_FULL, Backlog
from acquire.trigger.driver import TriggerDriver

LOAD = Load(256, "uint16", 20_000.0, substeps=2, stages=8, block_lines=128, ring_slots=256, chunk_lines=256)
"""20 MB/s from both arms, chunks of 128 KiB, a ring of 1.6 s."""
WAIT_S = 300.0


@contextlib.contextmanager
def capturing(disk: Disk, load: Load = LOAD, **changes: Any) -> Iterator[Capture]:
    wire = Wire()
    model = TriggerModel(wire, CLOCK_HZ, load.speed)
    trigger = TriggerDriver(partial(TwinTransport, model), TriggerConfig(tag_every_lines=load.block_lines))
    capture = Capture(replace(capture_plan(load, wire), realtime=False, disk=disk, **changes), trigger)
    try:
        capture.arm(2 * WAIT_S)
        yield capture
    finally:
        capture.close()
        trigger.close()
        wire.close()


def until_done(capture: Capture, path: Path) -> tuple[CaptureStatus, int]:
    """The end, and the most lines that were acknowledged; each time, a reader finds them."""
    deadline, acknowledged = time.monotonic() + WAIT_S, 0
    while not (seen := capture.poll()).done:
        if seen.committed_lines:
            acknowledged = seen.committed_lines
            assert open_recording(path).lines >= acknowledged
        assert seen.fault is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return seen, acknowledged


def check_lines(path: Path, load: Load = LOAD) -> None:
    """Every row is its line, and none is missing."""
    recording = open_recording(path)
    assert not recording.gaps
    for arm in ARMS:
        expected = Pattern(arm, load.pixels, load.dtype, 4095).lines(recording.first_line, recording.lines)
        np.testing.assert_array_equal(recording.camera(arm).lines[:], expected)
        assert not (recording.camera(arm).flags[:] & LineFlag.MISSING).any()


def check_graceful_end(capture: Capture, path: Path) -> None:
    seen, acknowledged = until_done(capture, path)
    assert seen.condition == "INTERRUPTED"
    assert "too slow to write: " in str(seen.end_reason)
    # seen coming, or, where the host held us up as well, ended before the first line that found no room
    assert re.search("ring slots of arm|ring of arm . was full at line", str(seen.end_reason))
    assert acknowledged > 0
    recording = open_recording(path)
    assert (recording.state, recording.attrs["end_reason"]) == ("sealed", seen.end_reason)
    assert recording.lines >= acknowledged
    assert verify(path).intact
    check_lines(path)
    for arm in ARMS:
        book = recording.attrs["ledger"][arm]
        assert book["balanced"]
        assert (book["stored"], book["missing"]) == (recording.lines, {})
    capture.close()
    assert all(account.balanced for account in capture.poll().accounts.values())


@pytest.mark.parametrize(("share", "block_lines"), [(0.2, 128), (0.6, 128), (0.6, 512)])
def test_a_slow_disk_ends_the_recording_before_a_line_is_lost(
    tmp_path: Path, share: float, block_lines: int
) -> None:
    path = tmp_path / "r.zarr"
    load = replace(
        LOAD, block_lines=block_lines, ring_slots=LOAD.ring_slots * LOAD.block_lines // block_lines
    )
    with capturing(SlowDisk(share * LOAD.bytes_per_s), load) as capture:
        capture.start(Begin(path, recording_spec(load, capture.clock)))
        check_graceful_end(capture, path)


def test_what_is_closed_between_two_segments_is_sealed_already(tmp_path: Path) -> None:
    load = replace(LOAD, ring_slots=LOAD.ring_slots // 4)  # it is emptied before a pause begins
    with capturing(SlowDisk(0.2 * load.bytes_per_s), load, continues=True) as capture:
        capture.start(Begin(tmp_path / "r.zarr", recording_spec(load, capture.clock)))
        life = capture._supervisor.life

        def pauses() -> bool:
            due_s = life.resumption._due_s
            lasts = life.stage is Stage.PAUSED and due_s is not None and due_s > time.monotonic() + 1.0
            return lasts and capture.poll().waiting.startswith(MEANINGS[Stage.PAUSED])

        until(pauses, "a pause that lasts, and is told")
        capture.close()  # nothing is left to be sealed: it must not wait for it, and fail
        seen = capture.poll()
    assert (seen.recording, seen.done, seen.orphans) == (False, True, ())
    assert str(seen.end_reason).startswith("too slow to write")
    assert open_recording(Path(str(seen.path))).state == "sealed"


@pytest.mark.needs_throttle
def test_a_disk_that_the_kernel_slows_down(tmp_path: Path) -> None:
    """From some moment on it takes a fifth of what comes; direct writes feel that at once."""
    path = tmp_path / "r.zarr"
    with capturing(DISK) as capture:
        capture.start(Begin(path, recording_spec(LOAD, capture.clock)))
        until(lambda: capture.poll().committed_lines > 0)
        pid = capture.pids["recorder"]
        assert pid is not None
        with Throttle(tmp_path, LOAD.bytes_per_s / 5) as throttle:
            throttle.take(pid)
            check_graceful_end(capture, path)


@pytest.mark.parametrize(
    ("number", "wholly", "share"),
    [
        (errno.ENOSPC, False, math.inf),
        (errno.EIO, False, math.inf),
        (errno.EIO, False, 0.8),  # in a hurry by then
        (errno.EROFS, True, math.inf),
    ],
)
def test_a_disk_that_fails_acknowledges_nothing_more(
    tmp_path: Path, number: int, wholly: bool, share: float
) -> None:
    """Sealed as aborted with what is there; on a disk that takes nothing any more, left as committed last."""
    path = tmp_path / "r.zarr"
    disk = FailingDisk(number, 16 * 2**20, tmp_path / "failed", wholly, share * LOAD.bytes_per_s)
    with capturing(disk) as capture:
        capture.start(Begin(path, recording_spec(LOAD, capture.clock)))
        seen, acknowledged = until_done(capture, path)
        assert seen.condition == "ABORTED"
        assert os.strerror(number) in str(seen.end_reason)
        assert ("nor could it be sealed" in str(seen.end_reason)) is wholly
        assert acknowledged > 0
        recording = open_recording(path)
        assert recording.lines >= acknowledged
        assert recording.state == ("recording" if wholly else "sealed")
        assert verify(path).intact
        check_lines(path)
        capture.close()
        assert [orphan.path for orphan in capture.poll().orphans] == ([path] if wholly else [])


# ---- when a backlog is one


@given(st.floats(0.02, 0.98), st.integers(16, 1000))
def test_a_ring_that_fills_in_small_steps_is_reported_before_it_is_full(share: float, slots: int) -> None:
    """``share`` of what comes is taken: looks from 0.9 on come before it overflows."""
    growth = 1 / share - 1
    assume(growth < min(2, (1 - NEARLY_FULL) * slots - 1))
    backlog, fill = Backlog(), 0.0
    while not backlog.grows(int(fill), slots):
        fill += growth
        assert fill <= slots


@given(st.lists(st.integers(0, 100), min_size=1))
def test_what_empties_is_none(pauses: list[int]) -> None:
    """After each pause the ring is fuller, even full; then it empties by one with every block."""
    backlog = Backlog()
    assert not backlog.grows(0, 100)
    for pause in pauses:
        for fill in range(pause, 0, -1):
            assert not backlog.grows(fill, 100)


def test_a_ring_that_begins_full_is_given_time() -> None:
    backlog = Backlog()
    assert not any(backlog.grows(100, 100) for _ in range(100))
    assert not backlog.grows(49, 100)
    assert [backlog.grows(95, 100) for _ in range(13)] == [False] * 12 + [True]  # after a pause
