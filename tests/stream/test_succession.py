"""Processes of a run that are killed while it records: others take their place, no line goes unaccounted."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from waiting import until

from acquire.config import RigConfig, builtin_directory, load_rig
from acquire.daemon.plan import Run
from acquire.errors import DeviceError
from acquire.lines import ARMS, LineFlag
from acquire.pattern import Pattern
from acquire.processes.nursery import nursery
from acquire.processes.worker import Worker
from acquire.rig import Rig
from acquire.store import open_recording
from acquire.store.recovery import recover
from acquire.stream import Orphan
from acquire.stream.lifecycle import Stage
from acquire.stream.messages import Begin
from acquire.stream.succession import Succession
from acquire.stream.supervisor import Supervisor

WAIT_S = 300.0
RIG = """
name = "pattern"
[geometry]
stages = 8
substeps = 2
[trigger]
substep_ticks = 4500         # lines at 10 kHz
tag_every_lines = 64
[cameras.a]
driver = "pattern"
serial = "A"
[cameras.b]
driver = "pattern"
serial = "B"
[stream]
block_lines = 64
ring_slots = 4096            # half a minute: a busy host takes its time to start a process
reopen_s = 20.0
[recording]
chunk_lines = 256
[simulation]
scene = "{scene}"
"""


@pytest.fixture
def config(tmp_path: Path) -> RigConfig:
    path = tmp_path / "rig.toml"
    path.write_text(RIG.format(scene=builtin_directory() / "scene-leds.toml"))
    return load_rig(path)


@pytest.fixture
def run(config: RigConfig) -> Iterator[Run]:
    with Rig(config) as rig:
        run = Run(config, rig)
        try:
            run.arm()
            yield run
        finally:
            run.capture.close()


def kill(run: Run, name: str) -> int:
    pid = run.capture.pids[name]
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    return pid


def check(path: Path) -> set[str]:
    """Every row holds its line, or is flagged and listed; the causes of what is missing."""
    recording = open_recording(path)
    listed = {arm: np.zeros(recording.lines, bool) for arm in ARMS}
    for gap in recording.gaps:
        first = gap.first_line - recording.first_line
        listed[gap.arm][first : first + gap.count] = True
    for arm in ARMS:
        stream = recording.camera(arm)
        missing = (stream.flags[:] & LineFlag.MISSING) != 0
        np.testing.assert_array_equal(missing, listed[arm])
        expected = Pattern(arm, 8, "uint16", 4095).lines(recording.first_line, recording.lines).copy()
        expected[missing] = 0
        np.testing.assert_array_equal(stream.lines[:], expected)
    return {gap.cause for gap in recording.gaps}


def check_books(run: Run) -> None:
    for arm in run.capture.poll().lines.values():
        told = arm["preroll"] + arm["lost"]["ring_full"] + arm["discarded"] + arm["recorded"] - arm["missing"]
        assert arm["delivered"] == told


def test_a_grabber_that_is_killed_is_replaced_and_the_gap_is_recorded(run, tmp_path):
    run.capture.start(Begin(tmp_path / "r.zarr", run.spec()))
    until(lambda: run.capture.poll().recorded_lines > 2000)
    kill(run, "b")
    until(lambda: run.capture.poll().lines["b"]["reopened"] == 1)
    goal = run.capture.poll().recorded_lines + 3000
    until(lambda: run.capture.poll().recorded_lines > goal)
    assert run.capture.poll().fault is None
    run.capture.stop("stopped")
    until(lambda: run.capture.poll().done)
    run.capture.close()
    assert run.capture.poll().condition == "INCOMPLETE"
    assert check(tmp_path / "r.zarr") == {"grabber_lost"}
    check_books(run)
    assert any("another took its place" in event.text for event in open_recording(tmp_path / "r.zarr").events)


def test_a_recorder_that_is_killed_is_replaced_and_no_line_is_lost(run, tmp_path):
    lines = 30_000
    run.capture.start(Begin(tmp_path / "r.zarr", run.spec(), lines))
    until(lambda: run.capture.poll().committed_lines > 2000)
    first = run.capture.poll().first_line
    kill(run, "recorder")
    until(lambda: run.capture.poll().done)
    seen = run.capture.poll()
    assert seen.fault is None
    assert seen.path == str(tmp_path / "r-2.zarr")
    (orphan,) = seen.orphans
    why = "its recorder was killed by SIGKILL; it continues in r-2.zarr"
    assert orphan == Orphan(tmp_path / "r.zarr", why, orphan.committed_lines)
    assert 2000 < orphan.committed_lines <= lines
    recover(orphan.path)
    one, two = (open_recording(tmp_path / name) for name in ("r.zarr", "r-2.zarr"))
    assert one.segments[0].path == two.path
    assert two.attrs["segment"]["outage"]["lines"] == 0
    assert one.first_line == first
    assert one.first_line < two.first_line <= one.first_line + one.lines
    assert two.first_line + two.lines == first + lines
    assert check(tmp_path / "r.zarr") == check(tmp_path / "r-2.zarr") == set()
    assert seen.condition in {"GOOD", "TAINTED"}  # lines may come before a tag has confirmed them
    assert any(event.kind == "resumed" and "SIGKILL" in event.text for event in two.events)


def test_marks_that_a_killed_recorder_did_not_write_are_passed_to_its_successor(run, tmp_path):
    run.capture.start(Begin(tmp_path / "r.zarr", run.spec()))
    until(lambda: run.capture.poll().committed_lines > 2000)
    recorder = run.capture.pids["recorder"]
    os.kill(recorder, signal.SIGSTOP)
    line = run.capture.note("mark", "the valve opens")
    os.kill(recorder, signal.SIGKILL)
    until(lambda: run.capture.poll().path.endswith("r-2.zarr") and run.capture.poll().committed_lines > 0)
    later = run.capture.note("mark", "and closes")
    run.capture.stop("stopped")
    until(lambda: run.capture.poll().done)
    two = open_recording(tmp_path / "r-2.zarr")
    marks = [(event.line, event.text) for event in two.events if event.kind == "mark"]
    assert marks == [(line, "the valve opens"), (later, "and closes")]


@pytest.mark.parametrize("begun", [True, False], ids=["once it has begun", "before it begins"])
def test_a_successor_that_is_killed_as_well_is_replaced_and_the_budget_stays(run, tmp_path, begun):
    lines = 40_000
    run.capture.start(Begin(tmp_path / "r.zarr", run.spec(), lines))
    until(lambda: run.capture.poll().committed_lines > 2000)
    first = run.capture.poll().first_line
    killed = kill(run, "recorder")
    until(lambda: run.capture.pids["recorder"] not in (None, killed))
    if begun:
        until(lambda: run.capture.poll().first_line != first and run.capture.poll().committed_lines > 0)
    kill(run, "recorder")
    until(lambda: run.capture.poll().done)
    seen = run.capture.poll()
    assert seen.fault is None
    assert len({orphan.path for orphan in seen.orphans} - {Path(seen.path)}) == (2 if begun else 1)
    recover(tmp_path / "r.zarr")
    parts = [open_recording(tmp_path / "r.zarr")]
    parts += parts[0].segments
    for orphan in seen.orphans[1:]:
        recover(orphan.path)
    parts = [part.refreshed() for part in parts]
    assert [part.attrs["segment"]["number"] for part in parts[1:]] == list(range(2, len(parts) + 1))
    for one, two in itertools.pairwise(parts):
        assert one.first_line < two.first_line <= one.first_line + one.lines
    assert parts[-1].first_line + parts[-1].lines == first + lines
    for part in parts:
        assert check(part.path) == set()


def test_what_the_ring_could_not_hold_meanwhile_is_a_gap(config, tmp_path):
    # 6 s: they fill while nobody can take its place, and hold what a busy host takes for its successor's disk
    short = config.model_copy(update={"stream": config.stream.model_copy(update={"ring_slots": 1024})})
    with Rig(short) as rig:
        run = Run(short, rig)
        try:
            run.arm()
            run.capture.start(Begin(tmp_path / "r.zarr", run.spec()))
            until(lambda: run.capture.poll().committed_lines > 2000)
            os.kill(nursery().pid, signal.SIGSTOP)  # nobody can take its place for a while
            try:
                os.kill(run.capture.poll().pids["recorder"], signal.SIGKILL)
                until(lambda: all(ring["drops"] for ring in run.capture.poll().ring.values()))
                beyond = max(arm["delivered"] for arm in run.capture.poll().lines.values())
            finally:
                os.kill(nursery().pid, signal.SIGCONT)
            until(lambda: (now := run.capture.poll()).first_line + now.committed_lines > beyond)
            run.capture.stop("stopped")
            until(lambda: run.capture.poll().done)
        finally:
            run.capture.close()
    recover(tmp_path / "r.zarr")
    one, two = (open_recording(tmp_path / name) for name in ("r.zarr", "r-2.zarr"))
    assert two.first_line <= one.first_line + one.lines
    # The rings were full; what the recorder had released and not committed is lost with it, if anything.
    causes = check(tmp_path / "r-2.zarr")
    assert {"ring_full"} <= causes <= {"recorder_lost", "ring_full"}
    assert check(tmp_path / "r.zarr") == set()
    # A slow host's successor starts with full rings and may be cut short by them; the reason must say so.
    condition = run.capture.poll().condition
    reason = open_recording(tmp_path / "r-2.zarr").attrs["end_reason"]
    full = condition == "INTERRUPTED" and "too slow to write: the ring of arm" in reason
    assert condition == "INCOMPLETE" or full, (condition, reason)


def test_what_is_killed_again_and_again_is_given_up(run, tmp_path, monkeypatch):
    monkeypatch.setattr("acquire.stream.succession.MOST", 1)
    run.capture.start(Begin(tmp_path / "r.zarr", run.spec()))
    first = kill(run, "a")
    until(lambda: run.capture.poll().lines["a"]["reopened"] == 1)
    assert run.capture.pids["a"] != first
    kill(run, "a")
    until(lambda: run.capture.poll().fault is not None)
    assert "killed by SIGKILL" in run.capture.poll().fault
    until(lambda: run.capture.poll().done)
    run.capture.close()
    assert run.capture.poll().condition == "INTERRUPTED"
    check(tmp_path / "r.zarr")
    check_books(run)


def test_a_recorder_that_is_killed_while_it_begins_refuses_at_once(run, tmp_path):
    """Another takes its place, and the next start finds it; what was left is named."""
    pid = run.capture.pids["recorder"]
    os.kill(pid, signal.SIGSTOP)
    with ThreadPoolExecutor(1) as user:
        started = user.submit(run.capture.start, Begin(tmp_path / "r.zarr", run.spec()))
        until(lambda: run.capture._supervisor.life.stage is Stage.ASKED)
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(DeviceError, match="start: the recorder was killed by SIGKILL"):
            started.result(WAIT_S)
    assert [orphan.path for orphan in run.capture.poll().orphans] == [tmp_path / "r.zarr"]
    run.capture.start(Begin(tmp_path / "s.zarr", run.spec(), 1000))
    until(lambda: run.capture.poll().done)
    assert check(tmp_path / "s.zarr") <= {"ring_full"}


def test_a_start_that_comes_while_a_recorder_is_replaced_finds_its_successor(run, tmp_path, monkeypatch):
    """It was sent to the successor, and then refused as one of the dead recorder: the answer was a fault."""
    end, life = Worker.end, run.capture._supervisor.life
    with ThreadPoolExecutor(1) as user:
        started = []

        def start_first(worker, deadline):
            if not started:
                begin = Begin(tmp_path / "r.zarr", run.spec(), 1000)
                started.append(user.submit(run.capture.start, begin))
                until(lambda: life.stage is Stage.ASKED)
            end(worker, deadline)

        monkeypatch.setattr(Worker, "end", start_first)
        kill(run, "recorder")
        until(lambda: started)
        started[0].result(WAIT_S)
    until(lambda: run.capture.poll().done)
    assert run.capture.poll().fault is None
    assert run.capture.poll().orphans == ()
    assert check(tmp_path / "r.zarr") <= {"ring_full"}


def test_a_capture_that_is_closed_while_its_recorder_is_replaced_does_not_record_on(
    run, tmp_path, monkeypatch
):
    """The dead recorder got the interruption, and its successor went on until the recording's end."""
    successor, interrupt, interrupted = Succession.successor, Supervisor.interrupt_recording, Event()

    def close_first(succession, name):
        if not interrupted.is_set():
            closed.append(user.submit(run.capture.close))
            assert interrupted.wait(WAIT_S)
        return successor(succession, name)

    def tell(supervisor, reason):
        interrupt(supervisor, reason)
        interrupted.set()

    run.capture.start(Begin(tmp_path / "r.zarr", run.spec(), 60_000))
    until(lambda: run.capture.poll().committed_lines > 2000)
    monkeypatch.setattr(Succession, "successor", close_first)
    monkeypatch.setattr(Supervisor, "interrupt_recording", tell)
    with ThreadPoolExecutor(1) as user:
        closed: list[Future[None]] = []
        kill(run, "recorder")
        until(lambda: closed)
        closed[0].result(WAIT_S)
    seen = run.capture.poll()
    assert (seen.condition, seen.end_reason) == ("INTERRUPTED", "the capture was closed")
    assert check(tmp_path / "r-2.zarr") == set()
