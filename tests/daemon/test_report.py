"""Rates, saturation, trigger and disk, as the status has them."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import replace
from pathlib import Path

import pytest
from fake_run import CALM
from waiting import until

from acquire.daemon.disk_watch import LEAST_S, LOOK_EVERY_S, SILENT_S, DiskWatch
from acquire.daemon.report import RATE_WINDOW_S, Rates, arm_statuses, trigger_status
from acquire.errors import StoreError
from acquire.stream import CaptureStatus
from acquire.stream.ledger import ArmLedger

BLOCK = 1000
RATE_HZ = 2500.0


def seen(delivered: dict[str, int], saturated: int = 0) -> CaptureStatus:
    lines = {arm: CALM.lines[arm] | {"delivered": n, "saturated": saturated} for arm, n in delivered.items()}
    return replace(CALM, lines=lines)


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def blocks(line: float) -> int:
    """Lines come when their block is whole."""
    return int(line // BLOCK) * BLOCK


@pytest.mark.parametrize("phase", [0, 300, 999])
def test_two_arms_of_one_trigger_have_one_rate(phase: int) -> None:
    """Blocks of 0.4 s, looked at five times a second: over 2 s the arms differed by a block in five."""
    clock = Clock()
    rates = Rates(clock)
    worst = 0.0
    for look in range(200):
        clock.now_s = look * 0.2
        lines = clock.now_s * RATE_HZ
        rates.update(seen({"a": blocks(lines), "b": blocks(lines + phase)}))
        if clock.now_s > RATE_WINDOW_S + 1:
            worst = max(worst, abs(rates.of("a") - rates.of("b")), abs(rates.of("a") - RATE_HZ))
    assert worst < 0.05 * RATE_HZ


def test_an_arm_that_falls_silent_comes_down_to_nothing() -> None:
    clock = Clock()
    rates = Rates(clock)
    found = []
    for look in range(100):
        clock.now_s = look * 0.2
        rates.update(seen({"a": blocks(min(clock.now_s, 8.0) * RATE_HZ)}))
        found.append(rates.of("a"))
    assert found[40] == pytest.approx(RATE_HZ, rel=0.1)
    assert 0 < found[50] < 0.9 * RATE_HZ
    assert found[-1] == 0


def test_saturation_is_of_the_last_seconds() -> None:
    clock = Clock()
    rates = Rates(clock)
    for look, (lines, saturated) in enumerate([(0, 0), (BLOCK, 500), (2 * BLOCK, 750), (3 * BLOCK, 1000)]):
        clock.now_s = look * 4.0
        rates.update(seen({"a": lines}, saturated))
    status = arm_statuses(seen({"a": 3 * BLOCK}, 1000), rates)["a"]
    assert status.saturated == 1000
    assert status.saturated_part == pytest.approx(0.25)


def test_lost_has_one_truth() -> None:
    """What never came is known to the ledger alone."""
    ledger = ArmLedger(
        issued=100,
        preroll=5,
        stored=60,
        discarded=0,
        lost={"undelivered": 35},
        waiting=0,
        pending=0,
        balanced=True,
    )
    status = arm_statuses(replace(seen({"a": 65}), accounts={"a": ledger}), Rates())["a"]
    assert status.ledger is not None
    assert {cause: n for cause, n in status.lost.items() if n} == status.ledger.lost == {"undelivered": 35}


def test_a_silent_trigger_is_reported() -> None:
    assert trigger_status(CALM) is None
    facts = {"clock_hz": 90_000_000, "uncertainty_ns": 900, "pulses": 7, "silent_s": 0.5}
    found = [trigger_status(replace(CALM, trigger=facts | {"silent_s": silent})) for silent in (0.5, 60.0)]
    assert [one.answers for one in found if one is not None] == [True, False]


class Disk:
    """A directory whose disk the test fills."""

    def __init__(self) -> None:
        self.clock, self.free, self.answers = Clock(), 10_000, threading.Event()
        self.answers.set()
        self.gone = False
        self.watch = DiskWatch(Path("/d"), 1000, 100.0, free_bytes=self._free_bytes, now_s=self.clock)

    def _free_bytes(self, _: Path) -> int:
        assert self.answers.wait(300)
        if self.gone:
            raise OSError(5, "Input/output error")
        return self.free

    def check(self, *, recording: bool = True) -> None:
        self.clock.now_s += LOOK_EVERY_S
        self.watch.check(recording=recording)
        self.watch.close()


def test_time_to_full_is_that_of_the_recording() -> None:
    disk = Disk()
    assert disk.watch.status is None
    disk.check(recording=False)
    found = disk.watch.status
    assert found is not None
    assert (found.free_bytes, found.bytes_per_s, found.seconds_to_full) == (10_000, 100.0, 90.0)
    for _ in range(5):
        disk.free -= 500
        disk.check()
    found = disk.watch.status
    assert found is not None
    assert (found.free_bytes, found.bytes_per_s, found.seconds_to_full) == (7500, 250.0, 26.0)
    assert 5 * LOOK_EVERY_S > LEAST_S
    disk.free = 500
    disk.check(recording=False)
    found = disk.watch.status
    assert found is not None
    assert found.seconds_to_full == 0


def test_a_disk_that_does_not_answer_keeps_nobody_waiting() -> None:
    disk = Disk()
    disk.check()
    disk.answers.clear()
    for _ in range(3):
        disk.clock.now_s += LOOK_EVERY_S
        disk.watch.check(recording=True)
    assert disk.watch.status is not None
    assert sum(thread.name == "disk-watch" for thread in threading.enumerate()) == 1
    disk.gone = True
    disk.answers.set()
    until(lambda: disk.watch.status is None, "the error")
    assert "Input/output error" in str(disk.watch.trouble)


def test_a_disk_that_does_not_answer_is_reported_and_refuses_a_start() -> None:
    disk = Disk()
    disk.check()
    disk.answers.clear()
    disk.clock.now_s += LOOK_EVERY_S
    disk.watch.check(recording=False)
    assert disk.watch.trouble is None
    disk.clock.now_s += SILENT_S + 1
    with pytest.raises(StoreError, match="has not answered for 11 s"):
        disk.watch.refuse(Path("/d/x.zarr"))
    disk.watch.refuse(Path("/e/x.zarr"))
    disk.answers.set()
    until(lambda: disk.watch.trouble is None, "the answer")
    assert disk.watch.came_back() is False  # nobody has looked while it was away


def test_a_query_that_fails_in_the_middle_of_a_check_does_no_harm() -> None:
    disk = Disk()
    disk.check()
    disk.check()
    disk.gone = True
    failing = threading.Thread(target=disk.watch._ask)

    class Looks(deque[tuple[float, int]]):
        def __len__(self) -> int:
            count = super().__len__()
            if failing.ident is None:
                failing.start()
                failing.join(0.2)
            return count

    disk.watch._looks = Looks(disk.watch._looks)
    disk.watch.check(recording=False)
    failing.join()
    disk.watch.close()
    assert disk.watch.status is None
