"""The cores available to this process, and the limit of BLAS threads."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from acquire import cores
from acquire.cores import (
    granted_threads,
    idle_cores,
    limit_blas,
    limit_threads,
    side_by_side,
    usable_cores,
)
from acquire.errors import NumericsError


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_is_limited_for_a_while() -> None:
    np.ones((2, 2)) @ np.ones((2, 2))
    with limit_blas(2):
        with limit_blas(1):
            assert blas_threads() == {1}
        assert blas_threads() == {2}


def test_both_results_come_from_threads_that_have_ended() -> None:
    before = threading.active_count()
    meet = threading.Barrier(2, timeout=30)  # each waits for the other: they run at the same time
    first, second = side_by_side(lambda: (1, meet.wait()), lambda: (2, meet.wait()))
    assert (first[0], second[0]) == (1, 2)
    assert threading.active_count() == before

    def fail() -> None:
        raise NumericsError("not finite")

    for pair in (fail, threading.active_count), (threading.active_count, fail):
        with pytest.raises(NumericsError, match="not finite"):
            side_by_side(*pair)
    assert threading.active_count() == before


def test_loops_get_no_more_threads_than_they_are_granted() -> None:
    with limit_threads(1):
        assert granted_threads() == 1


@pytest.mark.parametrize(
    ("files", "limit"),
    [
        ({}, float("inf")),
        ({"cpu.max": "max 100000\n"}, float("inf")),
        ({"cpu.max": "150000 100000\n"}, 1.5),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, float("inf")),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4.0),
    ],
)
def test_a_containers_quota_counts(tmp_path: Path, files: dict[str, str], limit: float) -> None:
    (tmp_path / "cpu").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert cores._quota(tmp_path) == limit


def test_cores_that_others_use_are_not_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    monkeypatch.setattr(cores, "_quota", lambda: float("inf"))
    for running, idle in ((1, 4), (3, 4), (5, 2), (6, 1), (60, 1)):
        monkeypatch.setattr(cores, "_running", lambda count=running: count)
        assert idle_cores() == idle
    monkeypatch.setattr(cores, "_quota", lambda: 2.5)
    assert usable_cores() == 3
    monkeypatch.setattr(cores, "_quota", lambda: 0.5)
    assert usable_cores() == 1


def test_slowness_is_the_share_of_a_core_without_hiccups(monkeypatch: pytest.MonkeyPatch) -> None:
    class Clock:
        """The clock of a thread that runs every third millisecond, and once not at all for a second."""

        used = 0

        def thread_time(self) -> float:
            self.used += 1
            return self.used * 1e-3

        def monotonic(self) -> float:
            return 3 * self.used * 1e-3 + (1.0 if self.used > 20 else 0.0)

    monkeypatch.setattr(cores, "time", Clock())
    assert cores.slowness() == pytest.approx(3.0, rel=0.5)


def test_a_process_has_an_age() -> None:
    assert 0 < cores.process_age_s() < 86_400


def test_this_thread_runs() -> None:
    assert cores._running() >= 1
