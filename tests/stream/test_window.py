"""Recordings that begin before they were asked for: what the rings still hold, line by line."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from slow_disks import PausingDisk
from test_capture import UNCONFIRMED, armed, check_balance, check_rows, sealed, until
from wired_devices import make_bench, make_spec

from acquire.errors import DeviceError, UsageError
from acquire.store import RunCondition
from acquire.stream.losses import Cause, Loss
from acquire.stream.messages import Begin, Note
from acquire.stream.ring import Ring, RingShape
from acquire.stream.threshold import ThresholdPlan
from acquire.stream.watcher import WatchPlan
from acquire.stream.window import Held, Window, hold, span
from acquire.trigger.base import TagEvent


@pytest.fixture
def make_ring() -> Iterator[Callable[..., Ring]]:
    made: list[Ring] = []

    def make(name: str, blocks: int, lost: range = range(0)) -> Ring:
        """A ring through which ``blocks`` blocks of 10 lines went but for those in ``lost``."""
        ring = Ring(name, RingShape(slots=16, rows=10, width=1, dtype="uint8", reserve=4))
        made.append(ring)
        losses = [Loss(10 * lost.start, 10 * len(lost), Cause.CAMERA)] if lost else []
        for block in range(blocks):
            if block not in lost:
                slot = ring.claim(10 * block, 10)
                assert slot is not None
                ring.commit(slot, losses if block == lost.stop else ())
                ring.release()
        return ring

    yield make
    for ring in made:
        ring.close()


def blocks(first: int, end: int) -> list[range]:
    return [range(line, line + 10) for line in range(first, end, 10)]


def test_both_arms_hold_what_is_asked_for(make_ring: Callable[..., Ring]) -> None:
    rings = {"a": make_ring("a", 40), "b": make_ring("b", 38)}
    held = hold(Window(pre_lines=45), rings)
    assert held == Held(at=380, from_line=330, taken={"a": blocks(330, 400), "b": blocks(330, 380)})
    assert span(Window(pre_lines=45), None, held, 1000.0).first_line == 335


def test_the_shorter_history_counts(make_ring: Callable[..., Ring]) -> None:
    rings = {"a": make_ring("a", 40), "b": make_ring("b", 5)}
    window = Window(at=390, pre_lines=375)
    held = hold(window, rings)
    assert held.from_line == 280  # of arm a; b has everything since line 0, and nothing after 50
    with pytest.raises(UsageError, match=r"375 lines from before \(0.375 s\).*up to 110 lines \(0.11 s\)"):
        span(window, None, held, 1000.0)


def test_lines_that_were_lost_are_known_to_be(make_ring: Callable[..., Ring]) -> None:
    rings = {"a": make_ring("a", 40), "b": make_ring("b", 40, lost=range(33, 36))}
    held = hold(Window(pre_lines=60), rings)
    assert held == Held(400, 340, {"a": blocks(340, 400), "b": blocks(360, 400)})
    assert span(Window(pre_lines=60), None, held, 1000.0).first_line == 340


def test_a_refusal_takes_nothing_back(make_ring: Callable[..., Ring]) -> None:
    """Else the cameras would have the reserve only, until all of it is let go of once more."""
    rings = {"a": make_ring("a", 40), "b": make_ring("b", 40, lost=range(28, 30))}
    for window, from_line in ((Window(pre_lines=121), 280), (Window(at=290, pre_lines=500), 280)):
        held = hold(window, rings)
        assert held == Held(window.at or 400, from_line, {})
        assert [ring.fill for ring in rings.values()] == [0, 0]
        with pytest.raises(UsageError, match="which both rings hold now"):
            span(window, None, held, 1000.0)
    assert hold(Window(pre_lines=120), rings).from_line == 280  # what was lost is known


@given(
    at=st.integers(0, 500),
    pre=st.integers(0, 300),
    post=st.none() | st.integers(1, 300),
    lines=st.none() | st.integers(1, 300),
    from_line=st.integers(0, 500),
)
def test_a_span_has_a_line_and_ends_where_it_should(
    at: int, pre: int, post: int | None, lines: int | None, from_line: int
) -> None:
    window = Window(at, pre, post, exact=False)
    found = span(window, lines, Held(at, from_line, {}), 1000.0)
    assert found.first_line == max(at - pre, from_line)
    if post is None and lines is None:
        assert found.end_line is None
        return
    assert found.end_line is not None
    assert found.end_line > found.first_line
    if lines is not None:
        assert found.end_line - found.first_line <= lines
    if post is not None and found.end_line > found.first_line + 1:
        assert found.end_line <= at + post


@pytest.mark.parametrize(("pre", "post"), [(-1, 1), (0, 0)])
def test_impossible_windows_are_refused(pre: int, post: int) -> None:
    with pytest.raises(UsageError, match="lines before"):
        Window(pre_lines=pre, post_lines=post)


def test_a_recording_begins_before_it_was_asked_for(tmp_path: Path) -> None:
    with armed(make_bench()) as capture:
        until(lambda: capture.poll().lines["b"]["delivered"] > 5000, "history")
        before = capture.poll()
        line = capture.note("mark", "something happened")
        capture.start(Begin(tmp_path / "r.zarr", make_spec(), None, Window(line, 3000, 1000)))
        status = sealed(capture)
    assert before.lines["a"]["discarded"] > 0
    assert (status.first_line, status.recorded_lines) == (line - 3000, 4000)
    assert (status.condition, status.end_reason) == (RunCondition.GOOD, "line budget reached")
    check_balance(capture.poll())
    recording, missing = check_rows(tmp_path / "r.zarr")
    assert (recording.first_line, recording.lines) == (line - 3000, 4000)
    assert not missing["a"].any()
    flags = recording.camera("a").flags[:]
    assert not (flags & UNCONFIRMED).any()  # the tags of what was before have come as any other
    assert [(event.kind, event.line, event.text) for event in recording.events] == [
        ("started", line - 3000, ""),
        ("mark", line, "something happened"),
    ]


def test_what_the_ring_does_not_hold_is_refused_with_what_it_does(tmp_path: Path) -> None:
    with armed(make_bench()) as capture:
        until(lambda: capture.poll().lines["b"]["delivered"] > 2000, "history")
        with pytest.raises(UsageError, match=r"50000 lines from before \(.* s\).*which both rings hold now"):
            capture.start(Begin(tmp_path / "r.zarr", make_spec(), 60_000, Window(pre_lines=50_000)))
        assert not any(tmp_path.iterdir())
        capture.start(Begin(tmp_path / "r.zarr", make_spec(), 6000, Window(pre_lines=50_000, exact=False)))
        status = sealed(capture)
    assert status.condition is RunCondition.GOOD
    assert status.recorded_lines == 6000
    check_rows(tmp_path / "r.zarr")
    check_balance(capture.poll())


def test_takes_of_one_run_overlap_and_every_line_counts_once(tmp_path: Path) -> None:
    """The second begins with lines that the first has stored; so does the third, after a recorder's death."""
    takes = []
    with armed(make_bench(ring_slots=4096)) as capture:
        until(lambda: capture.poll().lines["b"]["delivered"] > 2000, "history")
        for name, lines in (("0.zarr", 1500), ("1.zarr", 20_000), ("2.zarr", 40_000)):
            line = takes[0].first_line if takes else None
            window = Window(pre_lines=1000) if line is None else Window(line + 700, 0)
            capture.start(Begin(tmp_path / name, make_spec(), lines, window))
            if name == "2.zarr":
                until(lambda: capture.poll().committed_lines > 0, "a commit")
                recorder = capture.pids["recorder"]
                assert recorder is not None
                os.kill(recorder, signal.SIGKILL)
            takes.append(sealed(capture))
            assert takes[-1].accounts["a"].balanced
    first = takes[0].first_line
    assert first is not None
    assert takes[1].first_line == first + 700
    assert takes[2].path == str(tmp_path / "2-2.zarr")
    assert takes[2].first_line is not None
    end = takes[2].first_line + takes[2].recorded_lines
    for name in ("0.zarr", "1.zarr", "2-2.zarr"):
        assert not check_rows(tmp_path / name)[1]["b"].any()
    for account in capture.poll().accounts.values():
        assert account.balanced
        assert account.stored == end - first
        assert account.discarded >= 0


def test_what_a_take_was_to_begin_with_stays_in_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recorder is ended with stored lines in its hands, and nobody takes them from the rings again."""
    monkeypatch.setattr("acquire.stream.capture._LEAST_END_S", 2.0)
    disk = PausingDisk(tmp_path / "gate", "make")
    with armed(make_bench(disk=disk)) as capture:
        capture.start(Begin(tmp_path / "1.zarr", make_spec(), 3000))
        first = sealed(capture).first_line
        assert first is not None
        disk.gate.touch()
        capture._workers["recorder"].post(
            Begin(tmp_path / "2.zarr", make_spec(), None, Window(first + 700, 0))
        )
        until(disk.held.exists, "a disk that does not answer")
        assert all(account.stored <= 700 for account in capture.poll().accounts.values())
        with pytest.raises(DeviceError, match="recorder: the process did not end"):
            capture.close(0.0)
        status = capture.poll()
    for arm, account in status.accounts.items():
        assert account.balanced
        assert account.stored == 3000
        assert account.lost == {}
        assert status.ring[arm]["fill"] == 0


def test_what_the_trigger_tells_is_in_the_recording_that_begins_before_it(tmp_path: Path) -> None:
    """An edge at its input is an event; a camera that missed a pulse makes what follows doubtful."""
    bench = make_bench()
    with armed(bench) as capture:
        until(lambda: capture.poll().lines["b"]["delivered"] > 3000, "history")
        bench.trigger.told = [TagEvent(2500, 2500 * 2700, "input")]
        notes: list[Note] = []
        until(lambda: notes.extend(capture.take_events()) or notes, "the event")
        assert notes == [Note(2500, "input", "tick 6750000")]
        capture.start(Begin(tmp_path / "r.zarr", make_spec(), 20_000, Window(2500, 1000, exact=False)))
        bench.trigger.told = [TagEvent(2600, 2600 * 2700, "missed_trigger_b")]
        status = sealed(capture)
    recording, _ = check_rows(tmp_path / "r.zarr")
    assert recording.first_line == 1500
    listed = [(event.kind, event.line) for event in recording.events]
    assert {("input", 2500), ("missed_trigger_b", 2600)} <= set(listed)
    assert status.ledger["tainted_by"] == {"missed_trigger_b": 1}
    assert status.condition is RunCondition.TAINTED


def test_an_event_in_a_recording_lets_it_go_on(tmp_path: Path) -> None:
    with armed(make_bench()) as capture:
        capture.start(Begin(tmp_path / "r.zarr", make_spec(), 4000))
        until(lambda: capture.poll().recorded_lines > 100, "rows")
        line = capture.note("mark", "again")
        capture.extend(line + 6000)
        status = sealed(capture)
    assert status.first_line is not None
    assert status.first_line + status.recorded_lines == line + 6000
    check_rows(tmp_path / "r.zarr")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_watcher_that_dies_or_stops_costs_no_line(tmp_path: Path, number: signal.Signals) -> None:
    threshold = ThresholdPlan("a", 2000.0, 100.0, rising=True, average_lines=1)
    watch = WatchPlan(None, 512, {"a": 0.0, "b": 0.0}, threshold)
    with armed(make_bench(watch=watch)) as capture:
        notes: list[Note] = []
        until(lambda: notes.extend(capture.take_events()) or len(notes) > 2, "crossings")
        assert {note.kind for note in notes} == {"threshold"}
        capture.start(Begin(tmp_path / "r.zarr", make_spec(), 20_000, Window(pre_lines=1000, exact=False)))
        watcher = capture.pids["watcher"]
        assert watcher is not None
        os.kill(watcher, number)
        status = sealed(capture)
        if number is signal.SIGSTOP:
            os.kill(watcher, signal.SIGCONT)
    # tainted: on a busy host lines may come before a tag has confirmed them
    assert status.condition in (RunCondition.GOOD, RunCondition.TAINTED)
    assert (status.fault, status.recorded_lines) == (None, 20_000)
    recording, _ = check_rows(tmp_path / "r.zarr")
    kinds = {event.kind for event in recording.events}
    assert ("fault" in kinds) == (number is signal.SIGKILL)  # another took its place
    assert "threshold" in kinds
    for account in capture.poll().accounts.values():
        assert account.balanced
        assert account.stored == 20_000
