"""The whole capture path: real processes, real shared memory, real recordings; devices made of a wire."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import zarr
from waiting import until
from wired_devices import (
    CLOCK_HZ,
    CODE,
    PIXELS,
    SATURATED_EVERY,
    STAGES,
    SUBSTEP_TICKS,
    SUBSTEPS,
    Bench,
    issued,
    make_bench,
    make_spec,
    pixels_of,
)

from acquire.errors import StateError, TriggerError, UsageError
from acquire.lines import ARMS, LineFlag
from acquire.store import Recording, RunCondition, open_recording
from acquire.stream import Begin, Capture, CaptureStatus
from acquire.trigger.base import WATCHDOG, TagEvent

UNCONFIRMED = LineFlag.TIME_ESTIMATED | LineFlag.CODE_UNVERIFIED


@contextmanager
def armed(bench: Bench) -> Iterator[Capture]:
    capture = Capture(bench.plan, bench.trigger)
    try:
        capture.arm()
        yield capture
    finally:
        try:
            capture.close()
        finally:
            bench.wire.close()


def record_until(capture: Capture, path: Path, rows: int) -> None:
    """Start without a budget and let ``rows`` rows be written."""
    capture.start(Begin(path, make_spec()))
    until(lambda: capture.poll().recorded_lines > rows, f"{rows} rows")


def sealed(capture: Capture) -> CaptureStatus:
    until(lambda: capture.poll().done, "the seal")
    return capture.poll()


def check_rows(path: Path) -> tuple[Recording, dict[str, np.ndarray]]:
    """Every row of both arms against what the devices made; returns where lines are missing (arm → rows).

    Read by zarr-python alone, but for the table of gaps.
    """
    recording, group = open_recording(path), zarr.open_group(path, mode="r")
    first, rows = group.attrs["first_line"], group["a/lines"].shape[0]
    line = np.arange(first, first + rows)
    missing = {}
    for arm in ARMS:
        stored = {name: array[:] for name, array in group[arm].arrays()}
        gone = missing[arm] = (stored["flags"] & LineFlag.MISSING) != 0
        expected = pixels_of(arm, line)
        expected[gone] = 0
        assert stored["lines"].shape == (rows, PIXELS)
        assert np.array_equal(stored["lines"], expected)
        saturated = (stored["flags"] & LineFlag.SATURATED) != 0
        assert np.array_equal(saturated, (line % SATURATED_EVERY == 0) & ~gone)
        check_tags(stored, line)
        listed = np.zeros(rows, int)
        for gap in recording.gaps:
            if gap.arm == arm:
                listed[gap.first_line - first :][: gap.count] += 1
        assert np.array_equal(listed, gone)
        account = group.attrs["ledger"][arm]
        assert account["balanced"]
        assert account["stored"] == rows - gone.sum()
        assert sum(account["missing"].values()) == gone.sum()
    assert group.attrs["ledger"]["pulses"] == rows
    return recording, missing


def check_tags(stored: dict[str, np.ndarray], line: np.ndarray) -> None:
    tick = (SUBSTEPS * line + STAGES * SUBSTEPS - 1) * SUBSTEP_TICKS
    bits = CODE.bits(int(line[0]) * SUBSTEPS, len(line) * SUBSTEPS).reshape(-1, SUBSTEPS)
    assert np.array_equal(stored["code_index"], SUBSTEPS * line)
    assert np.array_equal(stored["code"], bits @ (1 << np.arange(SUBSTEPS)))
    assert np.array_equal(stored["tick"], tick)
    assert np.array_equal(stored["time"], 1_700_000_000_000_000_000 + tick * 10**9 // CLOCK_HZ)


def check_balance(status: CaptureStatus) -> None:
    """Of a closed capture: what each camera delivered is accounted for to the line."""
    for arm in ARMS:
        lines = status.lines[arm]
        stored = lines["recorded"] - lines["missing"]
        known = lines["preroll"] + lines["discarded"] + lines["lost"]["ring_full"] + stored
        assert lines["delivered"] == known > 0
        assert status.ring[arm]["fill"] == 0


def causes(recording: Recording) -> set[tuple[str, str]]:
    return {(gap.arm, gap.cause) for gap in recording.gaps}


def test_records_every_line_of_both_arms_as_it_was(tmp_path: Path) -> None:
    bench = make_bench()
    with armed(bench) as capture:
        assert capture.clock.clock_hz == CLOCK_HZ
        assert capture.cameras["b"]["Width"] == PIXELS
        assert capture.cameras["b"]["identity"]["serial"] == "b"
        with pytest.raises(StateError, match="nothing has been recorded"):
            capture.stop()
        until(lambda: capture.poll().lines["a"]["delivered"] > 2000, "lines while armed")
        with pytest.raises(UsageError, match="does not exist"):
            capture.start(Begin(tmp_path / "no" / "r.zarr", make_spec()))
        with pytest.raises(UsageError, match="cannot have 0 lines"):
            capture.start(Begin(tmp_path / "r.zarr", make_spec(), 0))
        for name in ("x" * 300, "nul\0.zarr"):
            with pytest.raises(UsageError, match="cannot be a path"):
                capture.start(Begin(tmp_path / name, make_spec()))
        assert not any(tmp_path.iterdir())

        capture.start(Begin(tmp_path / "budget.zarr", make_spec(), 5000))
        with pytest.raises(StateError, match="being written"):
            capture.start(Begin(tmp_path / "second.zarr", make_spec()))
        budget = sealed(capture)
        capture.stop()  # of what has ended by itself: nothing to do

        record_until(capture, tmp_path / "stopped.zarr", 3000)
        seen = capture.poll()
        assert (seen.recording, seen.done, seen.condition) == (True, False, None)
        capture.stop("told to")
        stopped = sealed(capture)
    after = capture.poll()
    assert after.lines["a"]["preroll"] == after.lines["b"]["preroll"] == STAGES + 1
    discarded = {arm: after.lines[arm]["discarded"] for arm in ARMS}
    assert min(discarded.values()) > 1900
    # What the first recording holds is neither discarded nor in the books of the second.
    for arm in ARMS:
        after.lines[arm]["recorded"] += 5000
    check_balance(after)
    assert after.ring["a"]["dropped_lines"] == 0
    assert after.ring["a"]["peak"] <= after.ring["a"]["slots"] == bench.plan.ring_slots
    assert bench.trigger.stops == 1
    for status, name, reason in (
        (budget, "budget", "line budget reached"),
        (stopped, "stopped", "told to"),
    ):
        recording, missing = check_rows(tmp_path / f"{name}.zarr")
        assert not missing["a"].any()
        assert not missing["b"].any()
        assert recording.state == "sealed"
        assert (status.condition, status.end_reason, status.fault) == (RunCondition.GOOD, reason, None)
        assert recording.attrs["run_condition"] == "GOOD"
        assert status.recorded_lines == status.committed_lines == recording.lines
        assert status.first_line == recording.first_line > 1900
    assert open_recording(tmp_path / "budget.zarr").lines == 5000
    assert open_recording(tmp_path / "stopped.zarr").lines > 3000


def test_losses_are_located_to_the_line_and_a_full_ring_ends_the_recording(tmp_path: Path) -> None:
    """A camera loses a block; then the recorder is held up until both rings overflow."""
    bench = make_bench(stall_timeout_s=20.0, ring_slots=256)
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        bench.wire["drop_b"] = 1
        until(lambda: capture.poll().lines["b"]["lost"]["camera"], "the camera's loss")
        lost_by_camera = capture.poll().lines["b"]["lost"]["camera"]
        recorder = capture.pids["recorder"]
        assert recorder is not None
        os.kill(recorder, signal.SIGSTOP)
        until(lambda: all(capture.poll().ring[arm]["drops"] > 3 for arm in ARMS), "overflowing rings")
        rows = capture.poll().recorded_lines
        os.kill(recorder, signal.SIGCONT)
        status = sealed(capture)
    check_balance(capture.poll())
    recording, missing = check_rows(tmp_path / "r.zarr")
    assert status.condition is RunCondition.INTERRUPTED
    # which of the two is seen first depends on how busy the host is
    assert re.search(r"was full at line|ring slots of arm [ab] wait", str(status.end_reason))
    # a block of 256 lines takes two of 256 slots
    assert recording.lines == status.committed_lines >= rows + 250 * 128
    assert causes(recording) == {("b", "camera")}
    assert missing["b"].sum() == lost_by_camera == 256
    assert {arm: status.lines[arm]["lost"]["ring_full"] for arm in ARMS} == {"a": 0, "b": 0}
    for arm, account in capture.poll().accounts.items():
        assert sum(account.lost.values()) == (256 if arm == "b" else 0)
        assert account.stored == recording.lines - status.lines[arm]["missing"]
        assert account.balanced


def test_a_stalled_arm_ends_the_recording_in_bounded_time(tmp_path: Path) -> None:
    bench = make_bench(stall_timeout_s=2.0)
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        bench.wire["stall_b"] = 1
        begun = time.monotonic()
        status = sealed(capture)
        assert time.monotonic() - begun < 60
    recording, missing = check_rows(tmp_path / "r.zarr")
    assert (status.condition, status.fault) == (RunCondition.INCOMPLETE, None)
    assert status.end_reason == "arm b stalled: no line for 2 s"
    assert causes(recording) == {("b", "stalled")}
    assert 0 < missing["b"].sum() < recording.lines
    assert np.flatnonzero(missing["b"])[-1] == recording.lines - 1


def test_a_stopped_trigger_ends_the_recording_without_missing_lines_in_doubt(tmp_path: Path) -> None:
    bench = make_bench(stall_timeout_s=2.0)
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        bench.wire["stop_ns"] = time.monotonic_ns()
        status = sealed(capture)
    check_rows(tmp_path / "r.zarr")
    assert status.condition is RunCondition.INTERRUPTED
    assert status.end_reason == "both arms stalled: no line for 2 s"


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("die", "grabber b: killed by SIGKILL"),
        ("raise", "grabber b: the link is down"),
        ("bug", "grabber b: ZeroDivisionError: a bug"),
    ],
)
def test_a_dead_grabber_is_a_fault_and_what_was_written_is_sealed(
    tmp_path: Path, fault: str, text: str
) -> None:
    bench = make_bench()
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        bench.wire[f"{fault}_b"] = 1
        until(lambda: capture.poll().fault, "the fault")
        status = sealed(capture)
        with pytest.raises(StateError, match="has failed"):
            capture.start(Begin(tmp_path / "next.zarr", make_spec()))
    recording, missing = check_rows(tmp_path / "r.zarr")
    assert status.fault == status.end_reason == text
    assert status.condition is RunCondition.INTERRUPTED
    assert recording.attrs["run_condition"] == "INTERRUPTED"
    assert not missing["a"].any()
    assert causes(recording) <= {("b", "arm_lost")}


def test_recording_begins_now_however_fast_the_lines_before_it_came(tmp_path: Path) -> None:
    """Cameras that were held up deliver what they have at once; that says nothing of the lines to come."""
    bench = make_bench(stall_timeout_s=20.0)
    for arm in ARMS:
        bench.wire[f"stall_{arm}"] = 1
    with armed(bench) as capture:
        until(lambda: issued(bench.wire, bench.trigger.rate_hz) > 12_000, "lines in the cameras")
        for arm in ARMS:
            bench.wire[f"stall_{arm}"] = 0
        until(lambda: capture.poll().lines["a"]["delivered"] > 256, "lines")
        capture.start(Begin(tmp_path / "r.zarr", make_spec(), 1000))
        assert capture.poll().first_line <= issued(bench.wire, bench.trigger.rate_hz)
        status = sealed(capture)
    # A machine with other work may let a ring run over, which is told; it may not wait for lines to come.
    assert (status.recorded_lines, status.end_reason) == (1000, "line budget reached")
    check_rows(tmp_path / "r.zarr")


@pytest.mark.parametrize(
    ("stalled", "fault"), [("stall_b", "arm b: no line for 2 s"), ("stop_ns", "arm a and b: no line for 2 s")]
)
def test_silence_while_armed_is_a_fault(tmp_path: Path, stalled: str, fault: str) -> None:
    bench = make_bench(stall_timeout_s=2.0)
    with armed(bench) as capture:
        until(lambda: capture.poll().lines["b"]["delivered"] > 1000, "lines")
        bench.wire[stalled] = time.monotonic_ns()
        until(lambda: capture.poll().fault, "the fault")
        assert capture.poll().fault == fault
        with pytest.raises(StateError, match="no line for 2 s"):
            capture.start(Begin(tmp_path / "r.zarr", make_spec()))
    assert not any(tmp_path.iterdir())


def test_a_camera_that_does_not_wait_for_the_trigger_is_a_fault() -> None:
    bench = make_bench(line_period_ns=5e4)
    bench.plan.openers["b"] = replace(bench.plan.openers["b"], rate_hz=40_000)
    with armed(bench) as capture:
        until(lambda: capture.poll().fault, "the fault")
        assert "arm b: line" in str(capture.poll().fault)
        assert "the camera does not wait for it" in str(capture.poll().fault)


def test_a_killed_recorder_leaves_what_was_committed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acquire.stream.succession.MOST", 0)  # nobody takes its place
    with armed(make_bench()) as capture:
        capture.start(Begin(tmp_path / "r.zarr", make_spec()))
        until(lambda: capture.poll().committed_lines > 1000, "commits")
        recorder = capture.pids["recorder"]
        assert recorder is not None
        os.kill(recorder, signal.SIGKILL)
        until(lambda: capture.poll().fault, "the fault")
        status = capture.poll()
    assert status.fault == "recorder: killed by SIGKILL"
    assert (status.recording, status.done, status.condition) == (False, False, None)
    recording = open_recording(tmp_path / "r.zarr")
    assert recording.state == "recording"
    assert recording.lines >= status.committed_lines > 1000
    line = np.arange(recording.first_line, recording.first_line + recording.lines)
    assert np.array_equal(recording.camera("b").lines[:], pixels_of("b", line))


def test_a_killed_owner_ends_everything_and_the_recording_is_sealed(tmp_path: Path) -> None:
    here = Path(__file__).parent
    command = [sys.executable, str(here / "doomed_owner.py"), str(tmp_path / "r.zarr")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as owner:
        try:
            assert owner.stdout is not None
            pids = json.loads(owner.stdout.readline())
            processes = [psutil.Process(pid) for pid in pids.values()]
        finally:
            owner.kill()
    _, alive = psutil.wait_procs(processes, timeout=300)
    assert not alive
    recording, _ = check_rows(tmp_path / "r.zarr")
    assert recording.lines >= 2000
    assert recording.attrs["run_condition"] == "INTERRUPTED"
    assert recording.attrs["end_reason"] == "the owner of the capture is gone"


def test_close_seals_what_is_being_recorded(tmp_path: Path) -> None:
    bench = make_bench()
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        capture.close()
        capture.close()
        status = capture.poll()
        with pytest.raises(StateError, match="not armed"):
            capture.start(Begin(tmp_path / "next.zarr", make_spec()))
        with pytest.raises(StateError, match="been used"):
            capture.arm()
    check_rows(tmp_path / "r.zarr")
    assert (status.done, status.recording) == (True, False)
    assert (status.condition, status.end_reason) == (RunCondition.INTERRUPTED, "the capture was closed")


def test_a_closed_capture_refuses_commands_in_words() -> None:
    """`stop` asked the rings first, whose memory was unmapped: a ValueError about memoryview objects."""
    bench = make_bench()
    with armed(bench) as capture:
        capture.close()
        for command in (capture.stop, lambda: capture.note("mark", ""), lambda: capture.extend(1)):
            with pytest.raises(StateError, match="this capture is not armed"):
                command()


def test_a_write_error_aborts_and_the_rings_are_emptied_all_the_same(tmp_path: Path) -> None:
    with armed(make_bench()) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        (tmp_path / "r.zarr").rename(tmp_path / "away.zarr")
        status = sealed(capture)
        assert status.condition is RunCondition.ABORTED
        assert status.end_reason is not None
        assert status.end_reason.startswith("write error: ")
        assert "possible" not in status.end_reason  # what was possible then
        capture.start(Begin(tmp_path / "next.zarr", make_spec(), 1000))
        assert sealed(capture).condition is RunCondition.GOOD
    check_rows(tmp_path / "next.zarr")


def test_lines_without_tags_are_flagged_not_lost(tmp_path: Path) -> None:
    bench = make_bench(tag_wait_s=0.05)
    bench.trigger.mute = True
    with armed(bench) as capture:
        capture.start(Begin(tmp_path / "r.zarr", make_spec(), 3000))
        status = sealed(capture)
    assert status.condition is RunCondition.TAINTED
    assert status.ledger["a"]["unverified"] == status.ledger["b"]["unverified"] == 3000
    check_rows(tmp_path / "r.zarr")
    flags = open_recording(tmp_path / "r.zarr").camera("a").flags[:]
    assert ((flags & UNCONFIRMED) == UNCONFIRMED).all()


def test_lines_wait_for_a_tag_that_is_not_due_yet(tmp_path: Path) -> None:
    """A tag each second, which a patience of less than that would not have waited for."""
    bench = make_bench(tag_wait_s=0.9, line_period_ns=50_000.0)
    bench = replace(bench, plan=replace(bench.plan, run=replace(bench.plan.run, tag_every_lines=20_000)))
    with armed(bench) as capture:
        capture.start(Begin(tmp_path / "r.zarr", make_spec(), 50_000))
        status = sealed(capture)
    assert (status.condition, status.ledger["tainted_by"]) == (RunCondition.GOOD, {})


def test_lines_wait_for_tags_that_this_process_is_too_busy_to_pass_on(tmp_path: Path) -> None:
    """At a load of six, the process that reads the trigger stood still longer than lines wait for tags."""
    bench = make_bench(tag_wait_s=0.5)
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        bench.trigger.hold_up_s = 1.0
        until(lambda: not bench.trigger.hold_up_s, "the hold-up")
        lines = capture.poll().recorded_lines
        until(lambda: capture.poll().recorded_lines > lines + 1000, "lines after it")
        capture.stop()
        status = sealed(capture)
    assert (status.condition, status.ledger["tainted_by"]) == (RunCondition.GOOD, {})


def test_tags_that_contradict_the_lines_taint_the_recording(tmp_path: Path) -> None:
    bench = make_bench(tag_wait_s=0.05)
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        bench.trigger.shift = 1
        until(lambda: capture.poll().recorded_lines > 3000, "lines under wrong tags")
        capture.stop()
        status = sealed(capture)
    recording, _ = check_rows(tmp_path / "r.zarr")
    assert status.condition is RunCondition.TAINTED
    assert status.ledger["tag_mismatches"] > 0
    assert any(event.kind == "tag_mismatch" for event in recording.events)


@pytest.mark.parametrize(
    ("error", "fault"),
    [
        (TriggerError("unplugged"), "trigger: unplugged"),
        (ZeroDivisionError("a bug"), "trigger: ZeroDivisionError: a bug"),
    ],
)
def test_a_trigger_that_fails_is_a_fault(tmp_path: Path, error: Exception, fault: str) -> None:
    bench = make_bench()
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        bench.trigger.broken = error
        until(lambda: capture.poll().fault, "the fault")
        assert capture.poll().fault == fault
    recording, _ = check_rows(tmp_path / "r.zarr")
    assert recording.attrs["run_condition"] == "INTERRUPTED"
    assert recording.attrs["end_reason"] == fault


def test_a_run_that_the_trigger_s_watchdog_ended_is_a_fault(tmp_path: Path) -> None:
    """At once: until the arms' silence is one, recordings could begin, and would be empty."""
    bench = make_bench()
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        bench.trigger.stop()
        bench.trigger.told = [TagEvent(1234, 5678, WATCHDOG)]
        until(lambda: capture.poll().fault, "the fault")
        assert str(capture.poll().fault).startswith("trigger: its watchdog ended the run at line 1234")
        with pytest.raises(StateError, match="watchdog"):
            capture.start(Begin(tmp_path / "later.zarr", make_spec()))
    recording, _ = check_rows(tmp_path / "r.zarr")
    assert recording.attrs["run_condition"] == "INTERRUPTED"
    assert "watchdog" in recording.attrs["end_reason"]


def test_a_defect_that_ends_the_supervisor_costs_no_recording(tmp_path: Path) -> None:
    """Its recorder seals it at the fault; nobody read that, and it was given up as not sealed in time."""
    bench = make_bench()
    with armed(bench) as capture:
        record_until(capture, tmp_path / "r.zarr", 1000)
        bench.trigger.told = [object()]  # type: ignore[list-item] - the defect of a driver
        until(lambda: capture.poll().fault, "the fault")
        assert "supervisor: AttributeError" in str(capture.poll().fault)
        capture.close()
        seen = capture.poll()
        assert (seen.done, seen.condition, seen.orphans) == (True, RunCondition.INTERRUPTED, ())
    recording = open_recording(tmp_path / "r.zarr")
    assert (recording.state, recording.lines) == ("sealed", seen.recorded_lines)


def test_a_supervisor_that_its_trigger_holds_up_is_reported_as_waiting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench, returns = make_bench(), threading.Event()
    with armed(bench) as capture:
        tags = bench.trigger.tags
        monkeypatch.setattr(bench.trigger, "tags", lambda limit_s: returns.wait(60) and tags(limit_s))
        until(lambda: capture.poll().waiting.startswith("the supervisor has shown no life for "), "the words")
        returns.set()
        until(lambda: not capture.poll().waiting, "an answer")
        assert capture.poll().fault is None
