"""Recordings as the page lists and shows them."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np
import pytest
from page_server import PageServer
from store_helpers import fill, make_spec
from waiting import until

from acquire.capacity.load import Load, recording_spec
from acquire.clock import ClockFit
from acquire.codes import PrbsCode
from acquire.errors import DataError, PlaceError
from acquire.lines import ARMS, LineBlock, LineFlag
from acquire.store import (
    RecordingSpec,
    RecordingWriter,
    RunCondition,
    open_recording,
    open_video,
    opening,
    video,
    write_video,
)
from acquire.store.layout import Document
from acquire.store.source import Source
from acquire.stream.tagger import Tagger
from acquire.trigger.base import TriggerRun
from acquire.web import archive as archive_module
from acquire.web.app import DiskReads, _prepare
from acquire.web.archive import LINES_PER_ROW, LOST_COLOUR, PICTURE_ROWS, Archive, _arm_overview
from acquire.web.messages import HoldRequest

CLOCK = ClockFit(90_000_000, 0, 0)
LOAD = Load(8, "uint16", 1000.0)
M, LINES, WHITE = 6, LINES_PER_ROW * PICTURE_ROWS, 4095


def test_damaged_and_missing_lines_are_shown_as_lost_and_listed(tmp_path: Path) -> None:
    code, clock = PrbsCode(15, 77), ClockFit(90_000_000, 1_700_000_000_000_000_000, 100)
    camera = {"white_dn": WHITE, "black_level_dn": 0.0, "responsivity_dn": 1.0}
    spec = RecordingSpec(
        run_id="run-1", stages=M, substeps=2, pixels=M, dtype="uint16", first_line=0, clock=clock,
        code=code.to_attrs(), substep_ticks=900, trigger={"model": "test"}, config={},
        cameras={"a": camera, "b": camera}, chunk_lines=16, codec="lz4",
    )  # fmt: skip
    tagger = Tagger(TriggerRun("run-1", code, 2, 900, 1), M, clock)
    tagger.confirmed_end = LINES
    pixels, flags = np.full((LINES, M), 819, np.uint16), np.zeros(LINES, np.uint16)
    rows = flags.reshape(PICTURE_ROWS, LINES_PER_ROW)
    rows[1], rows[2], rows[3, 1:] = LineFlag.INCOMPLETE, LineFlag.MISSING, LineFlag.INCOMPLETE
    pixels[flags != 0] = WHITE  # what an earlier frame left behind
    with RecordingWriter.create(tmp_path / "run.zarr", spec) as writer:
        for arm in ARMS:
            writer.append(tagger.tag(arm, LineBlock(0, pixels, flags)))
        writer.seal(RunCondition.TAINTED, "stopped", {"tainted_by": {"incomplete_b": 7, "tag_mismatches": 2}})
    opened = open_recording(tmp_path / "run.zarr")
    for arm in ARMS:
        picture = _arm_overview(opened, arm)
        assert (picture[1:3] == LOST_COLOUR).all()
        assert (np.delete(picture, (1, 2), axis=0) == 51).all()
    (listed,) = Archive(tmp_path).recordings()
    assert listed.tainted_by == ["arm b: 7 lines that arrived damaged", "tag mismatches: 2"]


def test_a_recording_of_any_name_is_listed_shown_and_held(tmp_path: Path) -> None:
    with RecordingWriter.create(tmp_path / "take 3", make_spec()) as writer:
        fill(writer, 64)
        writer.commit()
        archive = Archive(tmp_path)
        archive.hold("take 3", HoldRequest(first_line=archive.recording("take 3").first_line, lines=4))
        assert archive.recording("take 3").held
    (tmp_path / "older").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "take 3")
    assert [one.name for one in archive.recordings()] == ["take 3"]
    assert archive.recording("take 3").lines > 0
    assert archive.picture("take 3")
    for name in ("older", "link", "..", "", ".", "take 3/a"):
        with pytest.raises(PlaceError):
            archive.recording(name)


def test_a_hold_is_listed_before_the_writer_has_seen_it(tmp_path: Path) -> None:
    """It was looked for in another directory than the one in which it is."""
    with RecordingWriter.create(tmp_path / "run.zarr", make_spec()) as writer:
        fill(writer, 150)
        writer.commit()
        archive = Archive(tmp_path)
        assert [found.held for found in archive.recordings()] == [False]
        archive.hold("run.zarr", HoldRequest(first_line=1000, lines=8, why="flash"))
        assert [found.held for found in archive.recordings()] == [True]
        (held,) = archive.recording("run.zarr").hold_list
        assert (held.first_line, held.count, held.why) == (1000, 8, "flash")


def _truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def _set_config(root: Path, recording: object) -> None:
    document = json.loads(root.read_text())
    document["attributes"]["config"] = {"recording": recording}
    root.write_text(json.dumps(document))


def test_no_damage_is_answered_as_a_defect_of_the_server(tmp_path: Path) -> None:
    """500 stands for a defect; of a damaged recording it said so as well, and of one with an odd `config`."""
    with RecordingWriter.create(tmp_path / "whole.zarr", make_spec()) as writer:
        fill(writer, 150)
        writer.add_event("mark", 5, 1000, "here")
        writer.add_gap("a", 1003, 1, "camera")
        writer.seal(RunCondition.GOOD, "done", {})
    damages: dict[str, Callable[[Path], object]] = {
        "lines": lambda path: _truncate(path / "a" / "lines" / "c" / "0" / "0"),
        "arm": lambda path: shutil.rmtree(path / "b"),
        "events": lambda path: _truncate(path / "events" / "text" / "c" / "0"),
        "gaps": lambda path: _truncate(path / "gaps" / "count" / "c" / "0"),
        "root": lambda path: _truncate(path / "zarr.json"),
        "no-root": lambda path: (path / "zarr.json").unlink(),
        "text": lambda path: _set_config(path / "zarr.json", "x"),
        "number": lambda path: _set_config(path / "zarr.json", {"upload_to": 5}),
    }
    for name, damage in damages.items():
        damage(shutil.copytree(tmp_path / "whole.zarr", tmp_path / f"{name}.zarr"))
    os.mkfifo(tmp_path / "pipe.zarr")
    (tmp_path / "loop.zarr").symlink_to("loop.zarr")
    shutil.copytree(tmp_path / "whole.zarr", os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.zarr"))
    answers: dict[tuple[str, str], httpx.Response] = {}
    with (
        contextlib.closing(PageServer(tmp_path / "c.sock", tmp_path)) as page,
        httpx.Client(
            base_url=f"{page.address}api", headers={"Authorization": f"Bearer {page.operator}"}, timeout=60
        ) as ask,
    ):
        listed = {found["name"]: found for found in ask.get("/recordings").json()}
        for name in (*damages, "whole", "pipe", "loop", "caf%E9"):
            for of in ("", "/picture"):
                answers[name, of] = ask.get(f"/recordings/{name}.zarr{of}")
            answers[name, "/hold"] = ask.post(
                f"/recordings/{name}.zarr/hold", json={"first_line": 1000, "lines": 8}
            )
        assert ask.get("/health").status_code == 503  # there is no daemon
    codes = {place: answer.status_code for place, answer in answers.items()}
    assert set(codes.values()) == {200, 422, 424}, codes
    assert all("message" in answer.json() for answer in answers.values() if answer.status_code != 200)
    assert len(listed) == len(damages) + 2
    # What can be shown is shown.
    shown = ("lines", "arm", "text", "number", "events", "gaps")
    assert {codes[name, of] for name in shown for of in ("", "/picture")} == {200}
    assert "cut short" in listed["lines.zarr"]["damage"]
    details = {name: answers[name, ""].json() for name in ("whole", "events", "gaps")}
    assert "table events/text cannot be read" in details["events"]["damage"]
    assert (details["events"]["events"], details["events"]["event_list"]) == (None, [])
    assert details["events"]["lost_lines"] == details["whole"]["lost_lines"] == {"a": 1, "b": 0}
    assert "table gaps/count cannot be read" in details["gaps"]["damage"]
    assert (details["gaps"]["lost_lines"], details["gaps"]["events"]) == (None, 1)
    assert codes["root", "/picture"] == codes["no-root", "/hold"] == 424


def test_names_that_json_cannot_have_are_opened_as_they_are_listed(tmp_path: Path) -> None:
    """They were listed with escapes, and under the names in the list nothing was found."""
    with RecordingWriter.create(tmp_path / "x.zarr", make_spec()) as writer:
        fill(writer, 150)
        writer.seal(RunCondition.GOOD, "done", {})
    odd = {"caf\\udce9.zarr": b"caf\xe9.zarr", "\\x1b[0m.zarr": b"\x1b[0m.zarr", "a\nb.zarr": b"a\nb.zarr"}
    odd |= {"back\\slash.zarr": b"back\\slash.zarr", "a #?%20.zarr": b"a #?%20.zarr"}
    for name in odd.values():
        shutil.copytree(tmp_path / "x.zarr", os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
    cuts: dict[str, Any] = {}
    with (
        contextlib.closing(PageServer(tmp_path / "c.sock", tmp_path)) as page,
        httpx.Client(
            base_url=f"{page.address}api", headers={"Authorization": f"Bearer {page.operator}"}, timeout=60
        ) as ask,
    ):
        assert {one["name"] for one in ask.get("/recordings").json()} == {"x.zarr", *odd}
        for name in odd:
            asked = f"/recordings/{quote(name, safe='')}"
            assert ask.get(asked).json()["name"] == name
            assert ask.get(f"{asked}/picture").content.startswith(b"\x89PNG")
        # Jobs yield to everything else, so that each takes a minute on a busy host.
        for name in (some := list(odd)[:2]):
            job = {"kind": "cut", "recording": name, "first_line": 1000, "lines": 16}
            assert ask.post("/jobs", json=job).status_code == 200

        def done() -> bool:
            found = {job["recording"]: job for job in ask.get("/jobs").json()}
            cuts.update(found)
            return {job["state"] for job in found.values()} <= {"done", "failed"}

        until(done, "the jobs")
        for name in some:
            assert cuts[name]["state"] == "done", cuts[name]
            made = ask.get(f"/cuts/{quote(cuts[name]['result'], safe='')}")
            assert made.content.startswith(b"PK")


def test_the_first_list_is_made_before_anybody_asks(tmp_path: Path) -> None:
    """Of 500 recordings, it takes seconds."""
    with RecordingWriter.create(tmp_path / "run.zarr", recording_spec(LOAD, CLOCK)) as writer:
        writer.seal(RunCondition.GOOD, "stopped", {})
    known, absent = Archive(tmp_path), Archive(tmp_path / "absent")
    with contextlib.closing(DiskReads()) as reading:
        asyncio.run(_prepare(known, reading))
        asyncio.run(_prepare(absent, reading))  # whoever asks for that list is told
    assert set(known._facts) == {"run.zarr"}


def test_a_new_video_under_an_old_name_has_a_range_of_its_own(tmp_path: Path) -> None:
    archive, path, ranges = Archive(tmp_path), tmp_path / "film.zarr", []
    for brightest in (1.0, 8.0):
        frames = np.linspace(0, brightest, 4 * 6 * 6, dtype=np.float32).reshape(4, 6, 6)
        write_video(path, frames, np.arange(4), pixel_size=1.0, frame_interval_ns=1.0, provenance={})
        ranges.append(archive.video(path.name).high)
        shutil.rmtree(path)
    assert ranges[1] > 7 * (ranges[0] or 0.0) > 6


def test_a_damaged_video_is_reported_as_damaged(tmp_path: Path) -> None:
    """It was called a defect in the daemon."""
    path, frames = tmp_path / "film.zarr", np.random.default_rng(1).random((4, 6, 6), np.float32)
    write_video(path, frames, np.arange(4), pixel_size=1.0, frame_interval_ns=1.0, provenance={})
    seen = Archive(tmp_path)
    seen.video(path.name)  # its range is known from here on
    for file in (path / "0" / "c").rglob("*"):
        if file.is_file():
            os.truncate(file, file.stat().st_size // 2)
    for archive in (seen, Archive(tmp_path)):
        with pytest.raises(
            DataError, match=r"frames 0 to [03] of .*film.zarr.* cannot be read: .*; try: a copy"
        ):
            archive.frames(path.name, 0, 4)
    (path / "zarr.json").unlink()
    with pytest.raises(PlaceError):
        seen.video(path.name)


def test_a_video_of_which_nothing_was_written_is_black(tmp_path: Path) -> None:
    """One that was interrupted early; its range was that of no number, which no answer can hold."""
    path, frames = tmp_path / "film.zarr", np.full((4, 6, 6), np.nan, np.float32)
    write_video(path, frames, np.arange(4), pixel_size=1.0, frame_interval_ns=1.0, provenance={})
    found = Archive(tmp_path).video(path.name)
    assert (found.low, found.high) == (0.0, 1.0)
    assert Archive(tmp_path).frames(path.name, 0, 4) == (bytes(frames.size), [])


def test_frames_that_are_there_are_shown_and_the_others_named(tmp_path: Path) -> None:
    """One file that was missing refused the whole video."""
    path, frames = tmp_path / "film.zarr", np.random.default_rng(1).random((60, 256, 256), np.float32)
    write_video(path, frames, np.arange(60), pixel_size=1.0, frame_interval_ns=1.0, provenance={})
    whole, lost = Archive(tmp_path).frames(path.name, 0, 60)
    assert lost == []
    size = open_video(path).video.chunks[0]
    assert 2 * size < 60
    (path / "0" / "c" / "1" / "0" / "0").unlink()
    damaged = path / "0" / "c" / "0" / "0" / "0"
    os.truncate(damaged, damaged.stat().st_size // 2)
    archive = Archive(tmp_path)
    assert archive.video(path.name).missing == [(size, 2 * size)]
    shown, lost = archive.frames(path.name, 0, 60)
    assert lost == [range(2 * size)]
    end = 2 * size * 256**2
    assert shown[:end] == bytes(end)
    # Black and white follow from the frames that are there.
    late = [np.frombuffer(one, np.uint8)[end:].astype(int) for one in (shown, whole)]
    assert np.abs(late[0] - late[1]).max() < 10
    with pytest.raises(DataError, match="is missing"):
        archive.frames(path.name, size, size)


def test_lists_read_what_has_changed_and_remember_what_is_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each list read the roots of all entries, every three seconds: with 1000, 0.3 cores. And each twice."""
    for number in range(3):
        with RecordingWriter.create(tmp_path / f"run-{number}.zarr", recording_spec(LOAD, CLOCK)) as writer:
            writer.seal(RunCondition.GOOD, "stopped", {})
    frames = np.zeros((4, 6, 6), np.float32)
    write_video(
        tmp_path / "film.zarr", frames, np.arange(4), pixel_size=1.0, frame_interval_ns=1.0, provenance={}
    )
    read: list[str] = []
    read_root = opening.read_root

    def noted(source: Source) -> Document:
        read.append(Path(str(source)).name)
        return read_root(source)

    for module in (archive_module, opening, video):
        monkeypatch.setattr(module, "read_root", noted)
    archive = Archive(tmp_path)
    assert [(one.name, one.error) for one in archive.recordings()] == [
        (f"run-{number}.zarr", None) for number in (2, 1, 0)
    ]
    assert sorted(read) == ["film.zarr", "run-0.zarr", "run-1.zarr", "run-2.zarr"]
    assert [one.name for one in archive.videos()] == ["film.zarr"]
    read.clear()
    assert [one.name for one in archive.videos()] == ["film.zarr"]
    assert len(archive.recordings()) == 3
    assert read == []
    os.utime(tmp_path / "run-1.zarr/zarr.json", ns=(1, 1))
    shutil.rmtree(tmp_path / "run-0.zarr")
    shutil.rmtree(tmp_path / "run-2.zarr")
    shutil.move(tmp_path / "film.zarr", tmp_path / "run-2.zarr")
    assert [one.name for one in archive.recordings()] == ["run-1.zarr"]
    assert sorted(read) == ["run-1.zarr", "run-2.zarr"]
    assert set(archive._facts) == {"run-1.zarr"}
    assert set(archive._kinds) == {"run-1.zarr", "run-2.zarr"}


def test_only_the_newest_are_listed_and_older_ones_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(5):
        path = tmp_path / f"run-{number}.zarr"
        with RecordingWriter.create(path, recording_spec(LOAD, CLOCK)) as writer:
            writer.seal(RunCondition.GOOD, "stopped", {})
        os.utime(path, ns=(number, number))
    monkeypatch.setattr(archive_module, "MOST_LISTED", 2)
    archive = Archive(tmp_path)
    assert [one.name for one in archive.recordings()] == ["run-4.zarr", "run-3.zarr"]
    assert set(archive._kinds) == {"run-4.zarr", "run-3.zarr"}
    assert archive.videos() == []  # for which all are looked at, once
    assert len(archive._kinds) == 5
