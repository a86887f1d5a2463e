"""A run that goes on after an outage: in segments beside the first recording, which stays as it is."""

from __future__ import annotations

import hashlib
import json
import shutil

import numpy as np
import pytest
from store_helpers import Truth, fill, make_spec

from acquire.codes import PrbsCode
from acquire.errors import StateError, UsageError
from acquire.store import (
    Continuation,
    RecordingWriter,
    RunCondition,
    next_segment,
    open_recording,
    recover,
    verify,
)
from acquire.store.files import locked
from acquire.stream.succession import free_name


@pytest.fixture
def killed(tmp_path):
    """A recording that its writer has left after 80 lines."""
    path = tmp_path / "run.zarr"
    with RecordingWriter.create(path, make_spec()) as writer:
        fill(writer, 85)
        writer.commit()
    return path


def bytes_of(path):
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and file != path / "zarr.json"]
    return {file: hashlib.sha256(file.read_bytes()).digest() for file in files}


def resume(path, first_line, lines, **changes):
    place, spec = next_segment(path, make_spec(run_id="run-of-today", **changes), cause="power lost")
    writer = RecordingWriter.prepare(place, spec)
    writer.begin(first_line)
    with writer:
        fill(writer, lines)
        writer.seal(RunCondition.GOOD, "done", {})
    return place


def test_a_killed_recording_goes_on_in_segments(killed):
    with pytest.raises(UsageError, match=r"not sealed; try: acquire recover"):
        next_segment(killed, make_spec())
    recover(killed)
    before = bytes_of(killed)
    second = resume(killed, 1500, 40)
    third = resume(killed, 1700, 40)
    assert (second.name, third.name) == ("run-2.zarr", "run-3.zarr")
    assert bytes_of(killed) == before, "nothing but the list in the root has changed"
    first = open_recording(killed)
    assert first.attrs["segments"] == ["run-2.zarr", "run-3.zarr"]
    assert first.lines == 80
    period = round(first.line_period_ns)
    truth = Truth(make_spec())
    outage = open_recording(second).attrs["segment"]["outage"]
    assert outage == {
        "after_line": 1079,
        "lines": 420,
        "from_ns": int(truth.block("a", 1079, 1).tags.time_ns[0]) + period,
        "to_ns": int(truth.block("a", 1500, 1).tags.time_ns[0]),
        "cause": "power lost",
    }
    assert open_recording(third).attrs["segment"]["outage"]["after_line"] == 1539
    assert {r.attrs["run_id"] for r in (first, *first.segments)} == {"run-1"}
    for start in (1010, 1505, 1710):
        np.testing.assert_array_equal(first.cut(start, 20).lines[0], truth.block("a", start, 20).pixels)
    with pytest.raises(UsageError, match="5 lines from line 1600 on cannot be read in full"):
        first.cut(1600, 5)
    assert all(verify(path).intact for path in (killed, second, third))


def test_a_growing_recording_is_refreshed(tmp_path):
    with RecordingWriter.create(tmp_path / "run.zarr", make_spec()) as writer:
        seen = open_recording(tmp_path / "run.zarr")
        for lines in (32, 64):
            fill(writer, 32)
            writer.commit()
            seen, before = seen.refreshed(), seen
            assert (before.lines, seen.lines) == (lines - 32, lines)


def test_an_outage_in_which_the_trigger_began_anew_has_no_count_of_lines(killed):
    recover(killed)
    segment = open_recording(resume(killed, 0, 40)).attrs["segment"]
    assert segment["outage"]["lines"] is None
    assert open_recording(killed).cut(1000, 40).first_line == 1000


OTHER_CODE = PrbsCode(64, 99).to_attrs()


@pytest.mark.parametrize(
    "changes", [{"pixels": 16}, {"dtype": "uint8"}, {"layout": "compact"}, {"code": OTHER_CODE}]
)
def test_lines_of_another_kind_are_no_segment(killed, changes):
    recover(killed)
    with pytest.raises(UsageError, match="resuming"):
        next_segment(killed, make_spec(**changes))


def test_a_code_given_by_its_seed_continues_the_same_one_given_by_its_state(killed):
    recover(killed)
    code = PrbsCode.from_seed(64, 5)
    first = killed.with_name("by-seed.zarr")
    with RecordingWriter.create(first, make_spec(code=code.to_attrs())) as writer:
        fill(writer, 85)
        writer.seal(RunCondition.GOOD, "done", {})
    place, _ = next_segment(first, make_spec(code=PrbsCode(64, code.state).to_attrs()))
    assert place.name == "by-seed-2.zarr"


def test_a_segment_is_resumed_through_the_first(killed):
    recover(killed)
    second = resume(killed, 1500, 40)
    with pytest.raises(UsageError, match=r"a segment itself; possible: run\.zarr"):
        next_segment(second, make_spec())


def test_a_segment_that_cannot_be_listed_is_not_begun(killed):
    recover(killed)
    place, spec = next_segment(killed, make_spec())
    writer = RecordingWriter.prepare(place, spec)
    with locked(killed, "testing"), pytest.raises(StateError, match="another process"):
        writer.begin(1500)
    assert not place.exists()
    assert "segments" not in open_recording(killed).attrs


def go_on(path, number, first_line):
    """Lines that a successor of the recorder wrote while the first recording was still open."""
    follows = Continuation(path.name, number, first_line, None, "killed", listed=False)
    place = path.with_name(f"run-{number}.zarr")
    with RecordingWriter.create(place, make_spec(first_line=first_line, continues=follows)) as writer:
        fill(writer, 40)
        writer.seal(RunCondition.GOOD, "done", {})
    return place


def test_segments_are_listed_in_their_order_whenever_that_is(killed):
    recover(killed)
    names = [resume(killed, 1500 + 100 * k, 40).name for k in range(10)]
    assert names[-1] == "run-11.zarr"
    document = json.loads((killed / "zarr.json").read_bytes())
    document["attributes"]["segments"].remove("run-3.zarr")
    (killed / "zarr.json").write_text(json.dumps(document))
    recover(killed.with_name("run-3.zarr"))
    assert open_recording(killed).attrs["segments"] == names


def test_who_recovers_lists_what_went_on_meanwhile(killed):
    places = [go_on(killed, number, 1080 + 40 * number) for number in (3, 2)]
    (killed.parent / "run-x.zarr").mkdir()  # no recording, though it looks like a segment
    assert "segments" not in open_recording(killed).attrs
    recover(killed)
    assert open_recording(killed).attrs["segments"] == ["run-2.zarr", "run-3.zarr"]
    assert open_recording(killed).cut(1170, 20).first_line == 1170
    late = go_on(killed, 4, 1500)
    recover(late)
    assert open_recording(killed).attrs["segments"] == ["run-2.zarr", "run-3.zarr", "run-4.zarr"]
    before = (killed / "zarr.json").stat()
    assert not recover(places[0]).changed
    assert (killed / "zarr.json").stat().st_ino == before.st_ino


def test_a_segment_alone_is_recovered_all_the_same(killed):
    late = go_on(killed, 2, 1100)
    shutil.rmtree(killed)
    assert recover(late).lines == 40


def test_a_link_that_leads_nowhere_takes_a_segments_name(tmp_path):
    """A recorder that is replaced must find a name that it can have."""
    (tmp_path / "run-2.zarr").symlink_to(tmp_path / "nowhere")
    assert free_name(tmp_path / "run.zarr") == tmp_path / "run-3.zarr"
