"""Marks of a recording that a full disk has ended before their lines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from acquire.daemon.take import MOST_NAMED, Take, and_then, log_event, with_cause
from acquire.stream import CaptureStatus, Note

SEEN = replace(CaptureStatus(), first_line=1000, committed_lines=100)


def test_marks_after_the_last_line_are_named() -> None:
    take = Take(Path("r.zarr"), None)
    for line in (1000, 1099, 1100, 1200):
        log_event(Note(line, "mark", f"at {line}"), take)
    log_event(Note(1200, "input", "no mark"), take)
    assert take.marks_after(SEEN).endswith("sure to have all: 'at 1100', 'at 1200'")
    assert take.marks_after(replace(SEEN, committed_lines=201)) == ""


def test_the_age_of_the_last_commit_begins_with_each(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("acquire.daemon.take.time.monotonic", lambda: now[0])
    take, ages = Take(Path("r.zarr"), None), []
    for committed in (0, 500, 500, 900):
        now[0] += 3.0
        seen = CaptureStatus(path="r.zarr", committed_lines=committed)
        ages.append(take.status(seen).commit_age_s)
    assert ages == [None, 0.0, 3.0, 0.0]


def test_a_failure_says_its_reason_once() -> None:
    """What went wrong after it is added only if it is something else."""
    assert and_then("the disk is full", "the disk is full") == "the disk is full"
    assert and_then("no seal: the disk is full", "the disk is full") == "no seal: the disk is full"
    assert and_then("the disk is full", "b hangs") == "the disk is full; then, while ending: b hangs"
    assert with_cause("b hangs", replace(SEEN, end_reason="the disk is full"), ending=False) == "b hangs"


def test_of_many_marks_the_first_are_named_and_all_are_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    take = Take(Path("r.zarr"), None)
    with caplog.at_level("INFO"):
        for number in range(50):
            log_event(Note(2000 + number, "mark", f"mark {number}."), take)
    assert take.marks_after(SEEN).endswith(f"'mark {MOST_NAMED - 1}.' and {50 - MOST_NAMED} more")
    assert {record.__dict__["most"] for record in caplog.records} == {600}
    assert len(caplog.records) == 50
