"""Segments cut out of recordings, and what is said when they cannot be."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
from store_helpers import CAMERA, CODE, Truth, array_of, fill, make_spec, with_array

from acquire.errors import DataError, UsageError
from acquire.lines import ARMS, LineFlag
from acquire.store import RecordingWriter, RunCondition, open_recording, verify


@pytest.fixture(scope="module")
def sealed(tmp_path_factory):
    path = tmp_path_factory.mktemp("cut") / "r.zarr"
    with RecordingWriter.create(path, make_spec()) as writer:
        fill(writer, 150)
        writer.seal(RunCondition.GOOD, "done", {"a": 1})
    return open_recording(path)


def write(path, spec, change, lines=64):
    """A recording of one block per arm after ``change(block)``."""
    with RecordingWriter.create(path, spec) as writer:
        for arm in ARMS:
            writer.append(change(Truth(spec).block(arm, spec.first_line, lines)))
        writer.seal(RunCondition.TAINTED, "done", {})
    return open_recording(path)


@pytest.mark.parametrize(("first", "lines"), [(1000, 150), (1000, 1), (1149, 1), (1013, 70), (1064, 64)])
def test_cut_is_what_was_recorded(sealed, first, lines):
    segment = sealed.cut(first, lines)
    truth = [Truth(make_spec()).block(arm, first, lines) for arm in ARMS]
    np.testing.assert_array_equal(segment.lines, np.stack([block.pixels for block in truth]))
    np.testing.assert_array_equal(segment.time_ns, truth[0].tags.time_ns)
    np.testing.assert_array_equal(segment.code, CODE.bits(3 * first, segment.geometry.span))
    assert segment.mask.all()
    assert (segment.geometry.stages, segment.geometry.substeps, segment.geometry.lines) == (8, 3, lines)
    assert segment.first_line == first
    assert segment.substep_ns == 10_000.0
    assert (segment.black_level_dn, segment.responsivity_dn) == (10.0, 6.0)


@pytest.mark.parametrize(("first", "lines"), [(999, 1), (1000, 151), (1150, 1)])
def test_cut_outside_states_what_is_there(sealed, first, lines):
    with pytest.raises(UsageError, match="possible: lines 1000 to 1149"):
        sealed.cut(first, lines)


@pytest.mark.parametrize("lines", [0, -1])
def test_a_cut_of_no_lines_is_refused(sealed, lines):
    with pytest.raises(UsageError, match=rf"a range of {lines} lines cannot be read; possible: 1 or more"):
        sealed.cut(1010, lines)


def test_streams_are_lazy_arrays_of_one_length(sealed):
    stream = sealed.camera("b")
    assert len(stream) == sealed.lines == 150
    assert stream.line_number[[0, -1]].tolist() == [1000, 1149]
    assert stream.lines[3:5].shape == (2, 8)
    truth = Truth(make_spec()).block("b", 1000, 150)
    for array, values in (
        (stream.code_index, truth.tags.code_index),
        (stream.code, truth.tags.code),
        (stream.tick, truth.tags.tick),
        (stream.time_ns, truth.tags.time_ns),
        (stream.flags, truth.flags),
    ):
        np.testing.assert_array_equal(array[:], values)
    with pytest.raises(UsageError, match="possible: a, b"):
        sealed.camera("c")


def test_info_is_json(sealed):
    info = json.loads(json.dumps(sealed.info()))
    assert info["lines"] == 150
    assert info["state"] == "sealed"
    assert info["run_condition"] == "GOOD"
    assert info["line_rate_hz"] == pytest.approx(100_000 / 3)
    assert info["duration_s"] == pytest.approx(150 * 30e-6)
    assert info["start_ns"] == Truth(make_spec()).block("a", 1000, 1).tags.time_ns[0]
    assert info["bytes"] == sum(f.stat().st_size for f in sealed.path.rglob("*") if f.is_file())
    assert info["simulated"] is True
    assert info["ledger"]["a"] == 1


def test_samples_that_cannot_be_used_are_masked(tmp_path):
    def change(block):
        pixels, flags = block.pixels.copy(), block.flags.copy()
        if block.arm == "a":
            pixels[5, 2] = 4095
            flags[5] = LineFlag.SATURATED
            pixels[7], flags[7] = 0, LineFlag.MISSING
            block = with_array(block, "code", np.where(np.arange(len(block)) == 7, 0, block.tags.code))
        else:
            flags[9] = LineFlag.INCOMPLETE | LineFlag.CODE_UNVERIFIED
        return replace(block, pixels=pixels, flags=flags)

    segment = write(tmp_path / "r.zarr", make_spec(), change).cut(1000, 64)
    expected = np.ones((2, 64, 8), bool)
    expected[0, 5, 2] = expected[0, 7] = expected[1, 9] = False
    np.testing.assert_array_equal(segment.mask, expected)
    assert (segment.samples()[~expected] == 0).all()


def test_arms_with_cameras_of_their_own(tmp_path):
    other = {"white_dn": 1000, "black_level_dn": 20.0, "responsivity_dn": 3.0}
    spec = make_spec(cameras={"a": CAMERA, "b": other})
    segment = write(tmp_path / "r.zarr", spec, lambda block: block).cut(1000, 64)
    assert segment.black_level_dn == (10.0, 20.0)
    assert segment.responsivity_dn == (6.0, 3.0)
    np.testing.assert_array_equal(segment.mask[1], segment.lines[1] < 1000)
    assert segment.mask[0].all()
    assert not segment.mask[1].all()
    lines = segment.lines.astype(np.float64)
    np.testing.assert_allclose(segment.samples(np.float64)[0], (lines[0] - 10) / 6)
    b = np.where(segment.mask[1], (lines[1] - 20) / 3, 0)
    np.testing.assert_allclose(segment.samples(np.float64)[1], b)


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("geometry", "stages"), -1),
        (("geometry", "substeps"), 0),
        (("geometry", "pixels"), None),
        (("clock", "clock_hz"), 0),
        (("clock", "clock_hz"), -5),
        (("trigger", "line_period_ticks"), 0),
        (("code",), {"kind": "prbs"}),
        (("code",), {"kind": "morse"}),
        (("code",), 7),
        (("versions",), {}),
        (("cameras", "b", "responsivity_dn"), 0),
        (("cameras", "b", "responsivity_dn"), "much"),
        (("cameras", "a", "black_level_dn"), float("nan")),
        (("cameras", "a", "white_dn"), None),
        (("cameras",), []),
    ],
)
def test_damaged_metadata_is_refused_when_the_recording_is_opened(tmp_path, keys, value):
    path = write(tmp_path / "r.zarr", make_spec(), lambda block: block).path
    document = json.loads((path / "zarr.json").read_text())
    table = document["attributes"]
    for key in keys[:-1]:
        table = table[key]
    table[keys[-1]] = value
    (path / "zarr.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match=r"r\.zarr: the metadata of the recording is damaged: (?!\w*Error)"):
        open_recording(path)


@pytest.mark.parametrize("attribute", ["flag_values", "flag_meanings"])
def test_a_damaged_table_is_refused_when_it_is_read_and_the_lines_stay(tmp_path, attribute):
    recording = write(tmp_path / "r.zarr", make_spec(), lambda block: block)
    for file in (recording.path / "zarr.json", recording.path / "gaps" / "arm" / "zarr.json"):
        file.write_text(file.read_text().replace(attribute, "gone"))
    again = open_recording(recording.path)
    with pytest.raises(DataError, match="gaps/arm cannot be read"):
        _ = again.gaps
    assert (again.info()["gaps"], list(again.unreadable)) == (None, ["gaps", "events"])
    assert again.cut(1000, 64).mask.all()


@pytest.mark.parametrize("array", ["code", "code_index"])
def test_a_code_that_disagrees_names_the_first_line(tmp_path, array):
    def change(block):
        wrong = array_of(block, array).copy()
        if block.arm == "b":
            wrong[20:22] += 1
        return with_array(block, array, wrong)

    recording = write(tmp_path / "r.zarr", make_spec(), change)
    with pytest.raises(DataError, match=r"b: the code recorded with line 1020 .* \(2 of 64 lines"):
        recording.cut(1000, 64)
    assert recording.cut(1022, 42).geometry.lines == 42


def test_a_lost_file_is_not_taken_for_darkness(tmp_path):
    recording = write(tmp_path / "r.zarr", make_spec(), lambda block: block, lines=150)
    (tmp_path / "r.zarr" / "b" / "lines" / "c" / "1" / "0").unlink()
    with pytest.raises(DataError, match="line 1064 is recorded, but not on disk"):
        recording.cut(1060, 20)
    assert recording.cut(1000, 64).mask.all()


def test_what_took_the_place_of_a_file_is_named(tmp_path):
    recording = write(tmp_path / "r.zarr", make_spec(), lambda block: block)
    file = recording.path / "a" / "lines" / "c" / "0" / "0"
    file.unlink()
    file.mkdir()
    with pytest.raises(DataError, match="lines 1000 to 1009 cannot be read: it is a directory, not a file;"):
        open_recording(recording.path).cut(1000, 10)


def test_a_table_whose_file_is_gone_is_named(tmp_path):
    recording = write(tmp_path / "r.zarr", make_spec(), lambda block: block)
    with RecordingWriter.create(tmp_path / "e.zarr", make_spec()) as writer:
        writer.add_event("mark", 5, 1000, "here")
        writer.seal(RunCondition.GOOD, "done", {})
    shutil.rmtree(tmp_path / "e.zarr" / "events" / "text")
    with pytest.raises(DataError, match="table events/text cannot be read: its file c/0 is missing"):
        _ = open_recording(tmp_path / "e.zarr").events
    assert open_recording(tmp_path / "e.zarr").info()["events"] is None
    shutil.rmtree(recording.path / "overview")
    assert "overview/zarr.json cannot be read: zarr.json is missing" in verify(recording.path).contradictions


def test_the_advice_for_a_pipe_is_not_that_for_a_link(tmp_path):
    recording = write(tmp_path / "r.zarr", make_spec(), lambda block: block)
    os.mkfifo(recording.path / "a" / "pipe")
    with pytest.raises(DataError, match=r"holds a pipe, not touched: a/pipe; .*without a pipe"):
        verify(recording.path)


def test_lines_of_a_damaged_chunk_are_refused(tmp_path):
    recording = write(tmp_path / "r.zarr", make_spec(codec="none"), lambda block: block)
    with (tmp_path / "r.zarr" / "a" / "lines" / "c" / "0" / "0").open("r+b") as file:
        file.seek(2 * 4096)
        file.write(b"\xff\xff")
    with pytest.raises(DataError, match="lines 1010 to 1019 cannot be read"):
        recording.cut(1010, 10)
    assert recording.cut(1000, 16).mask.all()
