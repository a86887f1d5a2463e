"""Every pair of stage and event, on a real `Lifecycle`, against the drawing written out a second time."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from wired_devices import make_spec

import acquire
from acquire.errors import StateError, StoreError
from acquire.store import RunCondition
from acquire.stream.lifecycle import MEANINGS, TABLE, UNDER_WAY, Event, Lifecycle, Stage
from acquire.stream.messages import Began, Begin, End, Extend, Refused, Sealed

ARROWS = """
none start asked
none killed none
none died none
none fault none
asked began recording
asked refused none
asked overdue cancelled
asked killed none
asked died none
asked fault cancelled
cancelled start asked
cancelled began recording
cancelled refused none
cancelled killed none
cancelled died none
cancelled fault cancelled
recording stop recording
recording refused recording
recording killed replaced
recording died lost
recording disk_end paused
recording sealed sealed
recording fault recording
replaced stop replaced
replaced began recording
replaced refused lost
replaced killed replaced
replaced died lost
replaced fault replaced
paused stop sealed
paused began recording
paused refused paused
paused killed paused
paused died sealed
paused over sealed
paused fault sealed
sealed start asked
sealed stop sealed
sealed began recording
sealed refused sealed
sealed killed sealed
sealed died sealed
sealed fault sealed
lost stop lost
lost killed lost
lost died lost
lost fault lost
"""
NAMED = {"start": Event.BEGIN, "stop": Event.END, "disk_end": Event.DISK_END}
DRAWN = {
    (Stage(a), NAMED.get(e) or Event(e)): Stage(b)
    for a, e, b in (row.split() for row in ARROWS.split("\n") if row)
}
WAYS = {
    Stage.NONE: (),
    Stage.ASKED: (Event.BEGIN,),
    Stage.CANCELLED: (Event.BEGIN, Event.OVERDUE),
    Stage.RECORDING: (Event.BEGIN, Event.BEGAN),
    Stage.REPLACED: (Event.BEGIN, Event.BEGAN, Event.KILLED),
    Stage.PAUSED: (Event.BEGIN, Event.BEGAN, Event.DISK_END),
    Stage.SEALED: (Event.BEGIN, Event.BEGAN, Event.SEALED),
    Stage.LOST: (Event.BEGIN, Event.BEGAN, Event.DIED),
}
ROWS = {"a": 900, "b": 890}
SEALED = Sealed(RunCondition.GOOD, "line budget reached", {})
LINES = 5000
MOUNT = Path("/")
END_LINE = 500 + LINES
CUT_SHORT = Sealed(RunCondition.INTERRUPTED, "too slow to write", {}, end_line=1400)


class Bench:
    """A lifecycle to which anything may happen."""

    def __init__(self, directory: Path, stage: Stage = Stage.NONE, lines: int | None = None) -> None:
        self.directory, self.lines = directory, lines
        self.life = Lifecycle(continues=True)
        for event in WAYS[stage]:
            self.happen(event)
        assert self.life.stage is stage

    def happen(self, event: Event) -> object:
        life, begun = self.life, self.directory / "r.zarr"
        if event is Event.BEGAN:
            begun.mkdir(parents=True, exist_ok=True)  # as a recorder does
        end_line = None if self.lines is None else 500 + self.lines
        ways: dict[Event, Callable[[], object]] = {
            Event.BEGIN: lambda: life.begin(Begin(begun, make_spec(), self.lines)),
            Event.END: lambda: life.end("stopped"),
            Event.BEGAN: lambda: life.on_began(Began(500, end_line, MOUNT), 10.0),
            Event.REFUSED: lambda: life.on_refused(Refused(StoreError("the disk is full")), 10.0),
            Event.OVERDUE: life.on_overdue,
            Event.KILLED: lambda: life.on_killed("killed by SIGKILL", 850, 10.0),
            Event.DIED: life.on_died,
            Event.DISK_END: lambda: life.on_sealed(CUT_SHORT, ROWS, 850, 10.0),
            Event.SEALED: lambda: life.on_sealed(SEALED, ROWS, 850, 10.0),
            Event.FAULT: life.on_fault,
            Event.OVER: lambda: life.on_line(END_LINE),
        }
        return ways[event]()


@pytest.mark.parametrize(("stage", "event"), [*itertools.product(Stage, Event)])
def test_pair(stage: Stage, event: Event, tmp_path: Path) -> None:
    bench = Bench(tmp_path, stage, LINES)
    before = (bench.life.began, bench.life.sealed, bench.life.path, bench.life.orphans)
    if (stage, event) in DRAWN:
        bench.happen(event)
        assert bench.life.stage is DRAWN[stage, event]
        if bench.life.stage in UNDER_WAY:
            assert bench.life.began is not None
            assert bench.life.sealed is None
        assert (bench.life.sealed is not None) == (bench.life.stage is Stage.SEALED)
        return
    if event is Event.OVER:  # lines come at every stage
        assert bench.happen(event) is False
    else:
        with pytest.raises(StateError, match=MEANINGS[stage]) as refused:
            bench.happen(event)
        assert refused.value.hint, "nobody knows what to do about it"
    assert bench.life.stage is stage
    assert (bench.life.began, bench.life.sealed, bench.life.path, bench.life.orphans) == before


def test_the_table_is_as_drawn_and_every_stage_has_its_meaning_and_comes_to_rest() -> None:
    assert TABLE == DRAWN
    assert set(MEANINGS) == set(Stage)
    for stage in UNDER_WAY | {Stage.ASKED}:  # whatever else fails, the death of the recorder ends it
        assert TABLE[stage, Event.DIED] not in UNDER_WAY | {Stage.ASKED}


def test_the_document_has_the_words_of_the_table() -> None:
    document = (Path(acquire.__file__).parent / "daemon" / "OPERATION.md").read_text()
    rows = "".join(f"| {stage} | {meaning} |\n" for stage, meaning in MEANINGS.items())
    assert f"| stage | |\n|---|---|\n{rows}\n" in document


@pytest.mark.parametrize(
    ("stage", "text"),
    [
        (Stage.RECORDING, "start: a recording is being written; possible: stop; try: stop it first"),
        (
            Stage.ASKED,
            "start: a recording is being created; try: wait until it has begun (acquire status shows it), or "
            "disarm",
        ),
    ],
)
def test_a_start_is_refused_in_the_words_of_the_table(stage: Stage, text: str, tmp_path: Path) -> None:
    with pytest.raises(StateError) as caught:
        Bench(tmp_path, stage).happen(Event.BEGIN)
    assert str(caught.value) == text


def test_what_a_recorder_refused_to_go_on_with_is_lost_and_named_where_it_is(tmp_path: Path) -> None:
    bench = Bench(tmp_path, Stage.REPLACED)
    assert bench.life.orphans == (), "the other recorder has more to do"
    assert bench.happen(Event.REFUSED) is True
    assert bench.life.path == tmp_path / "r.zarr"
    bench.life.mark_unsealed("its recorder did not end in time", 0)
    assert [(orphan.path.name, orphan.committed_lines) for orphan in bench.life.orphans] == [("r.zarr", 850)]


def test_a_further_segment_is_named_when_it_exists_and_what_is_left_of_it_is_cleared_away(
    tmp_path: Path,
) -> None:
    bench = Bench(tmp_path, Stage.REPLACED)
    assert bench.life.path == tmp_path / "r.zarr", "the lines that are counted are in this one"
    bench.happen(Event.DIED)
    bench.life.mark_unsealed("its recorder died", 850)
    assert [(orphan.path.name, orphan.committed_lines) for orphan in bench.life.orphans] == [
        ("r.zarr", 850),
        ("r-2.zarr", 0),
    ]
    again = Bench(tmp_path / "again", Stage.REPLACED)
    again.happen(Event.BEGAN)
    assert again.life.path == tmp_path / "again/r-2.zarr"


def test_a_stop_during_a_pause_cancels_the_further_segment(tmp_path: Path) -> None:
    bench = Bench(tmp_path, Stage.PAUSED)
    assert bench.life.resumption.why == "too slow to write"
    assert bench.happen(Event.END) is True
    assert bench.life.sealed is CUT_SHORT
    assert bench.life.due(1e9) is None
    assert bench.happen(Event.BEGAN) == End("stopped"), "one that has begun all the same ends at once"


@pytest.mark.parametrize("then", [Event.REFUSED, Event.KILLED])
def test_a_further_segment_that_fails_is_tried_again_later(tmp_path: Path, then: Event) -> None:
    bench = Bench(tmp_path, Stage.PAUSED)
    following = bench.life.due(10.0)
    assert following is not None
    assert following.path == tmp_path / "r-2.zarr"
    assert bench.life.due(1e9) is None, "it is said once"
    for _ in range(3):
        assert bench.happen(then) in (False, None)
        assert bench.life.due(10.0) is None
        again = bench.life.due(100.0)
        assert again is not None
        assert again.spec.continues is not None
        assert again.spec.continues.number == 2
        assert again.mount == MOUNT, "its disk has to be there still"
    why = bench.life.resumption.why
    assert again.window.text == f"continues from r.zarr: too slow to write; and then {why}"


@pytest.mark.parametrize("event", [Event.END, Event.FAULT])
def test_what_has_been_told_to_end_does_not_go_on_after_the_disk_s_end(tmp_path: Path, event: Event) -> None:
    bench = Bench(tmp_path, Stage.RECORDING)
    bench.happen(event)
    bench.life.on_sealed(CUT_SHORT, ROWS, 850, 10.0)
    assert bench.life.stage is Stage.SEALED


def test_a_budget_stays_through_segments_and_can_be_prolonged_between_them(tmp_path: Path) -> None:
    bench = Bench(tmp_path, Stage.PAUSED, lines=5000)
    bench.life.extend(7000)
    following = bench.life.due(10.0)
    assert following is not None
    assert following.end_line == 7000
    one = Bench(tmp_path, Stage.RECORDING, lines=5000)
    successor = one.happen(Event.KILLED)
    assert isinstance(successor, Begin)
    assert (successor.window.at, successor.window.post_lines) == (500 + 850, 5000 - 850)


@pytest.mark.parametrize("stage", [Stage.REPLACED, Stage.PAUSED])
def test_a_segment_that_was_being_created_is_extended_once_it_has_begun(tmp_path: Path, stage: Stage) -> None:
    bench = Bench(tmp_path, stage, LINES)
    bench.life.due(10.0)
    bench.life.extend(7000)
    assert bench.happen(Event.BEGAN) == Extend(7000)
    assert bench.life.began == Began(500, 7000, MOUNT)
    assert Bench(tmp_path / "as-asked", stage, LINES).happen(Event.BEGAN) is None


def test_a_pause_ends_with_the_recording_s_end(tmp_path: Path) -> None:
    """Once the end has passed, every further segment would be refused, for ever."""
    bench = Bench(tmp_path, Stage.PAUSED, LINES)
    assert not bench.life.on_line(END_LINE - 1)
    assert bench.life.due(10.0) is not None
    assert not bench.life.on_line(END_LINE), "an attempt is under way, and may have begun before the end"
    bench.happen(Event.REFUSED)
    assert bench.life.on_line(END_LINE)
    assert bench.life.sealed is not None
    assert bench.life.sealed.condition is RunCondition.INTERRUPTED
    assert bench.life.sealed.end_reason.startswith("too slow to write; its end, line 5500, passed")
    assert (bench.life.resumption.why, bench.life.due(1e9)) == ("", None)


def test_a_pause_lasts_when_the_end_is_put_off_or_unknown(tmp_path: Path) -> None:
    bench = Bench(tmp_path, Stage.PAUSED, LINES)
    bench.life.extend(END_LINE + 100)
    assert not bench.life.on_line(END_LINE)
    assert bench.life.on_line(END_LINE + 100)
    assert not Bench(tmp_path / "open", Stage.PAUSED).life.on_line(10**9)


def test_lines_that_a_recording_holds_are_remembered_and_a_pause_holds_none(tmp_path: Path) -> None:
    bench = Bench(tmp_path, Stage.RECORDING)
    assert bench.life.kept("b", 800) == [(500, 800)]
    bench.happen(Event.DISK_END)
    assert bench.life.kept("b", 5000) == [(500, 500 + ROWS["b"])]


def test_an_end_that_the_disk_did_not_take_leaves_an_orphan(tmp_path: Path) -> None:
    bench = Bench(tmp_path, Stage.RECORDING)
    bench.life.on_sealed(replace(SEALED, on_disk=False), ROWS, 850, 10.0)
    assert [(orphan.path.name, orphan.committed_lines) for orphan in bench.life.orphans] == [("r.zarr", 850)]
    bench.life.mark_unsealed("closed", 0)
    assert len(bench.life.orphans) == 1


@pytest.mark.parametrize("stage", [Stage.RECORDING, Stage.LOST])
def test_what_is_not_sealed_at_the_end_is_to_be_recovered(tmp_path: Path, stage: Stage) -> None:
    bench = Bench(tmp_path, stage)
    bench.life.mark_unsealed("it was closed", 850)
    assert [(orphan.why, orphan.committed_lines) for orphan in bench.life.orphans] == [("it was closed", 850)]
