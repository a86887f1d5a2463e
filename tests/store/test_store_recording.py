"""Whole recordings, opened by zarr-python and xarray without us. Warnings are errors."""

from __future__ import annotations

import importlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from store_helpers import CLOCK, Truth, check_rows, fill, make_spec

from acquire import store
from acquire.errors import DataError, PlaceError, UsageError
from acquire.lines import ARMS, LineFlag
from acquire.store import (
    FORMAT,
    Event,
    Gap,
    RecordingWriter,
    RunCondition,
    next_segment,
    open_recording,
    verify,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "r.zarr"


def seal(writer, condition=RunCondition.GOOD, **ledger):
    writer.seal(condition, "line budget reached", ledger)


@pytest.mark.parametrize(
    ("codec", "dtype", "fsync"),
    [
        ("none", "uint8", "seal"),
        ("none", "uint16", "commit"),
        ("lz4", "uint8", "commit"),
        ("lz4", "uint16", "seal"),
        ("zstd", "uint16", "seal"),
    ],
)
def test_sealed_recording_holds_every_line(path, codec, dtype, fsync):
    spec = make_spec(codec=codec, dtype=dtype, fsync=fsync)
    with RecordingWriter.create(path, spec) as writer:
        fill(writer, 100)
        assert (writer.next_line("a"), writer.committed_lines) == (1100, 0)
        writer.commit()
        assert writer.committed_lines == 96
        fill(writer, 33)
        seal(writer, a={"stored": 133})
        assert writer.committed_lines == 133
    root = zarr.open_group(path, mode="r")
    check_rows(root, spec, 133)
    assert root.attrs["state"] == "sealed"
    assert root.attrs["run_condition"] == "GOOD"
    assert root.attrs["end_reason"] == "line budget reached"
    assert root.attrs["ledger"]["a"] == {"stored": 133}
    assert root.attrs["ledger"]["store"]["lines"] == 133
    assert root.attrs["ledger"]["store"]["lines_left_out"] == {"a": 0, "b": 0}
    assert root.attrs["ledger"]["store"]["bytes_written"] == writer.bytes_written > 0


@settings(max_examples=8, deadline=None)
@given(
    blocks=st.lists(st.tuples(st.sampled_from(ARMS), st.integers(1, 60), st.booleans()), max_size=16),
    chunk_lines=st.integers(1, 40),
    shard_chunks=st.integers(1, 3),
    tag_chunks=st.integers(1, 3),
)
def test_whatever_the_order_of_blocks_both_arms_show_the_same_lines(
    tmp_path_factory, blocks, chunk_lines, shard_chunks, tag_chunks
):
    path = tmp_path_factory.mktemp("p") / "r.zarr"
    spec = make_spec(chunk_lines=chunk_lines, shard_chunks=shard_chunks * tag_chunks, tag_chunks=tag_chunks)
    whole = chunk_lines * tag_chunks
    truth, given_lines = Truth(spec), dict.fromkeys(ARMS, 0)
    with RecordingWriter.create(path, spec) as writer:
        for arm, count, commit in blocks:
            writer.append(truth.block(arm, writer.next_line(arm), count))
            given_lines[arm] += count
            if commit:
                writer.commit()
                both = min(given_lines.values())
                assert writer.committed_lines == both // whole * whole
                check_rows(zarr.open_group(path, mode="r"), spec, writer.committed_lines)
        seal(writer)
    rows = min(given_lines.values())
    root = zarr.open_group(path, mode="r")
    check_rows(root, spec, rows)
    left_out = {arm: count - rows for arm, count in given_lines.items()}
    assert root.attrs["ledger"]["store"]["lines_left_out"] == left_out


def test_xarray_opens_an_arm_with_times_and_flags(path):
    spec = make_spec()
    with RecordingWriter.create(path, spec) as writer:
        fill(writer, 60)
        seal(writer)
    with xarray.open_zarr(path, group="a", chunks=None) as arm:
        assert arm["lines"].dims == ("line", "pixel")
        assert arm["lines"].dtype == np.uint16
        assert set(arm.coords) == {"time", "tick", "code_index"}
        truth = Truth(spec).arrays("a", 1000, 60)
        assert arm["time"].dtype == np.dtype("datetime64[ns]")
        np.testing.assert_array_equal(arm["time"].values.astype(np.int64), truth["time"])
        assert arm.attrs["first_line"] == 1000
        flags = arm["flags"].attrs
        assert dict(zip(flags["flag_meanings"].split(), flags["flag_masks"], strict=True)) == {
            flag.name.lower(): flag.value for flag in LineFlag
        }


def test_parts_opened_by_themselves_are_older_than_the_root_at_most(path):
    with RecordingWriter.create(path, make_spec()) as writer:
        for step in range(4):
            fill(writer, 40)
            writer.commit()
            alone = zarr.open_array(path / "a" / "time", mode="r").shape[0]
            assert alone in {0, *((k + 1) * 40 // 16 * 16 for k in range(step + 1))}
            assert zarr.open_group(path, mode="r")["a/time"].shape[0] == writer.committed_lines
        writer.seal(RunCondition.GOOD, "done", {})
    assert zarr.open_array(path / "a" / "time", mode="r").shape == (160,)


def test_every_way_of_opening_sees_a_growing_recording_alike(path, monkeypatch):
    monkeypatch.setattr("acquire.store.writer.OWN_INTERVAL_S", 0.0)
    spec = make_spec()
    with RecordingWriter.create(path, spec) as writer:
        for step in range(4):
            fill(writer, 40)
            writer.add_event("mark", step, 1000 + step, f"step {step}")
            writer.commit()
            rows = writer.committed_lines
            assert rows == (step + 1) * 40 // 16 * 16
            root = zarr.open_group(path, mode="r")
            check_rows(root, spec, rows)
            with xarray.open_datatree(path, engine="zarr") as tree:
                assert tree.attrs["format"] == FORMAT
                assert tree.attrs["state"] == "recording"
                assert {name: tree[name].sizes["line"] for name in ARMS} == {"a": rows, "b": rows}
                np.testing.assert_array_equal(tree["b/lines"].values, root["b/lines"][:])
                assert list(tree["events/text"].values) == [f"step {i}" for i in range(step + 1)]
            with xarray.open_zarr(path, group="b", chunks=None) as arm:
                assert arm.sizes["line"] == rows
            with xarray.open_zarr(path / "b", chunks=None) as arm:
                assert arm.sizes["line"] == rows
            for name in (*ARMS, "gaps", "events"):
                assert list(zarr.open_group(path / name, mode="r").array_keys())
            assert zarr.open_array(path / "a" / "time", mode="r").shape == (rows,)


def test_unconsolidated_listing_finds_nothing_foreign(path):
    with RecordingWriter.create(path, make_spec()) as writer:
        fill(writer, 20)
        seal(writer)
    root = zarr.open_group(path, mode="r", use_consolidated=False)
    names = {name for name, _ in root.members(max_depth=None)}
    lines = {f"{arm}/{name}" for arm in ARMS for name in Truth(make_spec()).arrays(arm, 0, 1)}
    tables = {f"gaps/{c}" for c in ("first_line", "count", "cause", "arm")}
    tables |= {f"events/{c}" for c in ("tick", "line", "kind", "text")}
    overview = {f"overview/{name}" for name in (*ARMS, "line")}
    assert names == {"a", "b", "gaps", "events", "overview"} | lines | tables | overview
    assert [file.name for file in path.rglob(".*")] == [".attributes"]


def test_attributes_say_what_the_run_was(path):
    spec = make_spec()
    RecordingWriter.create(path, spec).close()
    attrs = dict(zarr.open_group(path, mode="r").attrs)
    assert attrs["format"] == "acquire-recording/2"
    assert attrs["layout"] == "dual"
    assert attrs["state"] == "recording"
    assert attrs["run_condition"] is None
    assert attrs["geometry"] == {"stages": 8, "substeps": 3, "pixels": 8}
    assert attrs["trigger"] == {
        "model": "simulated",
        "serial": "T1",
        "clock_hz": 90_000_000,
        "substep_ticks": 900,
        "line_period_ticks": 2700,
    }
    assert attrs["clock"] == CLOCK.to_attrs()
    assert attrs["code"] == spec.code
    assert attrs["cameras"] == spec.cameras
    assert attrs["config"] == {"name": "test"}
    assert attrs["simulated"] is True
    assert attrs["scene"] == {"kind": "leds"}
    assert attrs["first_line"] == 1000


def test_gaps_and_events_are_read_back(path):
    with RecordingWriter.create(path, make_spec()) as writer:
        writer.add_gap("b", 1003, 5, "ring_full")
        writer.add_gap("a", 1010, 1, "camera")
        writer.add_event("started", 12, 1000)
        writer.add_event("camera reset", 2**63, 1003, "by hand")
        writer.commit()
        recording = open_recording(path)
        assert recording.gaps == (Gap("b", 1003, 5, "ring_full"), Gap("a", 1010, 1, "camera"))
        assert recording.events == (
            Event("started", 12, 1000, ""),
            Event("camera_reset", 2**63, 1003, "by hand"),
        )
        seal(writer)
    with xarray.open_zarr(path, group="gaps", chunks=None) as gaps:
        assert gaps["first_line"].values.tolist() == [1003, 1010]
        assert gaps["first_line"].dims == ("gap",)
    assert open_recording(path).info()["lost_lines"] == {"a": 1, "b": 5}


def test_close_without_seal_leaves_what_was_committed(path):
    spec = make_spec()
    writer = RecordingWriter.create(path, spec)
    fill(writer, 40)
    writer.commit()
    fill(writer, 40)
    writer.close()
    writer.close()
    recording = open_recording(path)
    assert (recording.state, recording.lines) == ("recording", 32)
    check_rows(zarr.open_group(path, mode="r"), spec, 32)
    for late in (writer.commit, lambda: fill(writer, 1), lambda: seal(writer)):
        with pytest.raises(UsageError, match="closed"):
            late()


def test_a_recording_of_no_lines_is_a_recording(path):
    with RecordingWriter.create(path, make_spec()) as writer:
        seal(writer, RunCondition.ABORTED)
    with xarray.open_datatree(path, engine="zarr") as tree:
        assert tree["a"].sizes["line"] == 0
    recording = open_recording(path)
    assert recording.info()["lines"] == 0
    with pytest.raises(UsageError, match="no lines"):
        recording.cut(1000, 1)


def test_a_commit_without_news_touches_nothing(path):
    with RecordingWriter.create(path, make_spec()) as writer:
        fill(writer, 20)
        writer.commit()
        before = (path / "zarr.json").stat().st_ino
        fill(writer, 3)
        writer.commit()
        assert (path / "zarr.json").stat().st_ino == before


def test_blocks_that_do_not_continue_are_refused(path):
    spec = make_spec()
    truth = Truth(spec)
    with RecordingWriter.create(path, spec) as writer:
        writer.append(truth.block("a", 1000, 5))
        for first in (1004, 1006):
            with pytest.raises(DataError, match="possible: line 1005"):
                writer.append(truth.block("a", first, 5))
        block = truth.block("a", 1005, 5)
        for wrong in (
            {"pixels": block.pixels.astype(np.uint8)},
            {"pixels": block.pixels[:, :-1]},
            {"tags": replace(block.tags, code=block.tags.code[:-1])},
        ):
            with pytest.raises(DataError, match="arm a"):
                writer.append(replace(block, **wrong))
        writer.append(block)  # a refused block is not a failure of the writer
        writer.append(truth.block("b", 1000, 10))
        seal(writer)
    check_rows(zarr.open_group(path, mode="r"), spec, 10)


def test_a_ledger_that_is_not_json_is_refused_before_the_end(path):
    with RecordingWriter.create(path, make_spec()) as writer:
        with pytest.raises(UsageError, match="ledger"):
            seal(writer, x=np.int64(3))
        seal(writer, x=3)


def damage_root(path, change):
    document = json.loads((path / "zarr.json").read_bytes())
    change(document)
    (path / "zarr.json").write_text(json.dumps(document))


def test_what_is_not_a_recording_says_so(path, tmp_path):
    with pytest.raises(PlaceError, match="does not exist"):
        open_recording(path)
    with pytest.raises(PlaceError, match="not a recording: it holds no"):
        open_recording(tmp_path)
    zarr.create_group(tmp_path / "other.zarr")
    with pytest.raises(PlaceError, match=r"it states no format.*possible: 'acquire-recording/1', 'acq"):
        open_recording(tmp_path / "other.zarr")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["attributes"].pop("geometry"), "damaged"),
        (lambda d: d["attributes"].pop("cameras"), "damaged"),
        (lambda d: d["attributes"].pop("ledger"), "damaged"),
        (lambda d: d.pop("attributes"), "damaged"),
        (lambda d: d["consolidated_metadata"]["metadata"].pop("b/flags"), "damaged"),
        (lambda d: d["consolidated_metadata"]["metadata"]["a/lines"].update(data_type="?"), "damaged"),
    ],
)
def test_damaged_metadata_is_reported(path, change, message):
    with RecordingWriter.create(path, make_spec()) as writer:
        seal(writer)
    damage_root(path, change)
    with pytest.raises(DataError, match=message):
        open_recording(path)


def test_a_newer_format_is_reported(path):
    with RecordingWriter.create(path, make_spec()) as writer:
        seal(writer)
    damage_root(path, lambda d: d["attributes"].update(format="acquire-recording/3"))
    with pytest.raises(PlaceError, match=r"acquire-recording/3.*newer version"):
        open_recording(path)


def test_a_recording_that_lost_its_root_metadata_is_damaged_and_no_wrong_path(path):
    with RecordingWriter.create(path, make_spec()) as writer:
        seal(writer)
    (path / "zarr.json").unlink()
    with pytest.raises(DataError, match=r"root metadata, zarr\.json, is missing"):
        open_recording(path)


def test_truncated_metadata_is_reported(path):
    RecordingWriter.create(path, make_spec()).close()
    data = (path / "zarr.json").read_bytes()
    (path / "zarr.json").write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match="damaged"):
        open_recording(path)


def test_directory_lost_under_the_writer(path):
    """A commit that cannot be published raises, and is not acknowledged."""
    writer = RecordingWriter.create(path, make_spec())
    fill(writer, 40)
    writer.commit()
    fill(writer, 40)
    shutil.rmtree(path)
    with pytest.raises(DataError, match=r"failed while committing.*32 lines of each arm"):
        writer.commit()
    assert writer.committed_lines == 32
    with pytest.raises(DataError, match="no more lines after a disk error"):
        fill(writer, 1)
    writer.close()


def test_a_seal_that_failed_can_be_repeated(path):
    spec = make_spec()
    writer = RecordingWriter.create(path, spec)
    fill(writer, 20)
    flags = path / "b" / "flags"
    flags.rename(path / "elsewhere")
    with pytest.raises(DataError, match="failed while sealing"):
        seal(writer)
    assert writer.committed_lines == 0
    (path / "elsewhere").rename(flags)
    seal(writer, RunCondition.INCOMPLETE)
    check_rows(zarr.open_group(path, mode="r"), spec, 20)


def test_a_recording_of_format_1_opens_and_has_the_same_code(path):
    """There the register's state was called the seed."""
    with RecordingWriter.create(path, make_spec()) as writer:
        fill(writer, 400)
        seal(writer)
    code = open_recording(path).cut(1000, 100).code

    def as_it_was(document):
        attributes = document["attributes"]
        attributes["format"] = "acquire-recording/1"
        attributes["code"].update(seed=attributes["code"].pop("state"))

    damage_root(path, as_it_was)
    recording = open_recording(path)
    assert recording.attrs["format"] == "acquire-recording/1"
    np.testing.assert_array_equal(recording.cut(1000, 100).code, code)
    assert (verify(path).damage, verify(path).contradictions) == ((), ())
    place, _ = next_segment(path, make_spec())
    assert place.name == f"{path.stem}-2.zarr"
    known = recording.info()["code"]
    assert (known["state"], known["seed"]) == (make_spec().code["state"], None)


def test_what_the_package_offers_is_what_is_asked_for():
    """Each name leads to what it says, whichever module was imported before."""
    for name in sorted({path.stem for path in Path(store.__path__[0]).glob("[a-z]*.py")}):
        importlib.import_module(f"acquire.store.{name}")
        assert name not in store.__all__, f"module {name} would take the place of what has its name"
    for name in store.__all__:
        assert not isinstance(getattr(store, name), ModuleType), name
