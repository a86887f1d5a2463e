"""What `recover` makes of a recording with damaged tables of events or gaps: their loss costs no line."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from store_helpers import Truth, make_spec
from typer.testing import CliRunner

from acquire.cli import app
from acquire.lines import ARMS, LineFlag
from acquire.store import Circumstances, Event, RecordingWriter, RunCondition, open_recording, recover, verify
from acquire.store.table_reader import TEXT_LOST

SPEC = make_spec(codec="none")
LOST = range(40, 43)
LEDGER = {"a": {"stored": 150, "missing": {}}, "b": {"stored": 147, "missing": {"ring_full": 3}}}


def left(path: Path, *, sealed: bool = False) -> Path:
    """A recording of which arm b lacks three lines, with two marks; its writer was killed, or sealed it."""
    truth = Truth(SPEC)
    writer = RecordingWriter.create(path.with_name("growing.zarr"), SPEC)
    with writer:
        for arm in ARMS:
            block = truth.block(arm, SPEC.first_line, 150)
            gone = np.isin(np.arange(150), LOST) & (arm == "b")
            flags = np.where(gone, LineFlag.MISSING, 0).astype(np.uint16)
            writer.append(replace(block, flags=flags))
        writer.add_gap("b", SPEC.first_line + LOST.start, len(LOST), "ring_full")
        writer.add_event("mark", 5, 1005, "the valve opens")
        writer.add_event("mark", 9, 1009, "it closes")
        writer.commit()
        if not sealed:
            shutil.copytree(writer.path, path)
        writer.seal(RunCondition.INCOMPLETE, "done", LEDGER)
    if sealed:
        writer.path.rename(path)
    else:
        shutil.rmtree(writer.path)
    return path


def cut_short(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:40])


@pytest.mark.parametrize("column", ["first_line", "count", "arm", "cause"])
@pytest.mark.parametrize("sealed", [False, True])
@pytest.mark.parametrize("trusted", [False, True])
def test_gaps_that_cannot_be_read_are_listed_anew_from_the_flags(
    tmp_path: Path, column: str, sealed: bool, trusted: bool
) -> None:
    """It refused the recording altogether."""
    path = left(tmp_path / "r.zarr", sealed=sealed)
    cut_short(path / "gaps" / column / "c" / "0")
    done = recover(path, known=Circumstances(committed_intact=trusted))
    lost = done.tables_lost["gaps"]
    assert done.changed
    assert f"table gaps/{column} cannot be read: the checksum is wrong" in lost
    assert "1 gap was listed from the flags, without the cause" in lost
    again = open_recording(path)
    (gap,) = again.gaps
    assert (gap.arm, gap.first_line, gap.count, gap.cause) == ("b", 1040, 3, "unlisted")
    assert [event.text for event in again.events if event.kind == "mark"] == ["the valve opens", "it closes"]
    assert again.attrs["tables_lost"] == {"gaps": lost}
    assert [event.text for event in again.events][-1] == lost
    assert again.attrs["ledger"]["b"]["stored"] == again.lines - 3
    found = verify(path)
    assert (found.damage, found.contradictions) == ((), ())
    assert found.notes == (f"lost of a table when it was recovered: {lost}",)
    assert not recover(path).changed


def test_lines_that_are_lost_besides_the_gaps_are_booked_once(tmp_path: Path) -> None:
    path = left(tmp_path / "r.zarr", sealed=True)
    (path / "gaps" / "count" / "c" / "0").unlink()
    shutil.rmtree(path / "a" / "lines" / "c" / "0")  # lines 1000 to 1063
    recover(path)
    again = open_recording(path)
    assert again.attrs["ledger"]["a"] == {"stored": 86, "missing": {"damaged": 64}}
    assert again.attrs["ledger"]["b"] == LEDGER["b"]
    assert verify(path).contradictions == ()


@pytest.mark.parametrize(
    ("column", "kept"),
    [
        ("text", [("mark", 1005, TEXT_LOST), ("mark", 1009, TEXT_LOST)]),
        ("kind", [("other", 1005, "the valve opens"), ("other", 1009, "it closes")]),
        ("tick", [("mark", 1005, "the valve opens"), ("mark", 1009, "it closes")]),
        ("line", []),
    ],
)
@pytest.mark.parametrize("sealed", [False, True])
def test_columns_of_events_that_are_whole_are_kept(
    tmp_path: Path, column: str, kept: list[tuple[str, int, str]], sealed: bool
) -> None:
    path = left(tmp_path / "r.zarr", sealed=sealed)
    cut_short(path / "events" / column / "c" / "0")
    lost = recover(path).tables_lost["events"]
    words = "1 event was" if len(kept) == 1 else f"{len(kept)} events were"
    count = f"{words} kept without it" if kept else "no event was kept"
    assert lost == f"table events/{column} cannot be read: the checksum is wrong; {count}"
    again = open_recording(path)
    *events, recovered, of_table = again.events
    assert [(event.kind, event.line, event.text) for event in events] == kept
    assert recovered.kind == "recovered"
    assert of_table == Event("recovered", 0, again.first_line + again.lines, lost)
    assert len(again.gaps) == 1
    assert verify(path).intact


def test_an_event_that_the_recorder_was_sent_is_listed_again(tmp_path: Path) -> None:
    """The daemon remembers marks for a recorder that dies before it has listed them."""
    path = left(tmp_path / "r.zarr")
    (path / "events" / "line" / "c" / "0").unlink()
    recover(path, known=Circumstances(notes=((1005, "mark", "the valve opens"),)))
    assert ("mark", 1005, "the valve opens") in [
        (e.kind, e.line, e.text) for e in open_recording(path).events
    ]


@pytest.mark.parametrize("trusted", [False, True])
def test_tables_that_are_lost_with_the_root_are_named(tmp_path: Path, trusted: bool) -> None:
    """They became empty tables, without a word."""
    path = left(tmp_path / "r.zarr")
    for file in ("zarr.json", "gaps/arm/zarr.json", "events/zarr.json"):
        (path / file).unlink()
    done = recover(path, known=Circumstances(committed_intact=trusted))
    assert done.root_rebuilt
    assert sorted(done.tables_lost) == ["events", "gaps"]
    assert "table events is lost: events/zarr.json cannot be read" in done.tables_lost["events"]
    assert [(gap.first_line, gap.count) for gap in open_recording(path).gaps] == [(1040, 3)]
    assert open_recording(path).tables_lost == done.tables_lost
    assert verify(path).intact


def test_the_commands_say_what_was_lost_of_a_table(tmp_path: Path) -> None:
    path = left(tmp_path / "r.zarr")
    cut_short(path / "events" / "text" / "c" / "0")
    for command, said in (
        ("recover", "lost of a table: table events/text cannot be read"),
        ("info", "incomplete marks and other events, or their texts, have been incomplete since"),
        ("verify", "note: lost of a table when it was recovered"),
    ):
        result = CliRunner().invoke(app, [command, str(path)])
        assert (result.exit_code, said in " ".join(result.output.split())) == (0, True), result.output
