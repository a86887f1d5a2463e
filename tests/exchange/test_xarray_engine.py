"""``xarray.open_dataset(…, engine="acquire")``, and the view of xarray and zarr without it."""

from __future__ import annotations

import tomllib
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray
import zarr

from acquire.clock import ClockFit
from acquire.codes import PrbsCode
from acquire.errors import UsageError
from acquire.exchange.xarray_engine import AcquireBackend
from acquire.lines import ARMS, LineBlock
from acquire.store import RecordingSpec, RecordingWriter, RunCondition, open_recording, open_video
from acquire.stream.tagger import Tagger
from acquire.trigger.base import TriggerRun

FIRST, LINES = 100, 90


def test_the_entry_point_leads_here() -> None:
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    module, _, name = tomllib.loads(text)["project"]["entry-points"]["xarray.backends"]["acquire"].partition(
        ":"
    )
    assert getattr(import_module(module), name) is AcquireBackend


def test_lines_are_found_by_their_number(recording: Path) -> None:
    opened = open_recording(recording)
    for arm in ARMS:
        with xarray.open_dataset(recording, engine=AcquireBackend, group=arm) as dataset:
            np.testing.assert_array_equal(dataset["lines"].sel(line=123), opened.camera(arm).lines[23])
            part = dataset["lines"].sel(line=slice(130, 140))
            np.testing.assert_array_equal(part, opened.camera(arm).lines[30:41])
            assert isinstance(dataset.indexes["line"], pd.RangeIndex)  # no memory, however many lines
            assert {"time", "tick", "code_index"} <= set(dataset["lines"].coords)
            np.testing.assert_array_equal(
                dataset["time"].values.astype(np.int64), opened.camera(arm).time_ns[:]
            )


def test_a_video_has_its_coordinates(video: Path) -> None:
    file = open_video(video)
    with xarray.open_dataset(video, engine=AcquireBackend) as dataset:
        assert set(dataset["video"].coords) == {"t", "y", "x", "time", "trusted"}
        np.testing.assert_array_equal(dataset["video"], file.video[:])
        np.testing.assert_array_equal(dataset["video"].sel(t=5e-5, method="nearest"), file.video[5])
        np.testing.assert_array_equal(dataset["video"][dataset["trusted"]], file.video[3:17])
    with xarray.open_dataset(video, engine=AcquireBackend, drop_variables="time") as dataset:
        assert "time" not in dataset.variables


def test_missing_items_are_reported(recording: Path, video: Path) -> None:
    with pytest.raises(UsageError, match="possible: a, b"):
        xarray.open_dataset(recording, engine=AcquireBackend, group="c")
    with pytest.raises(UsageError, match="a video has no groups"):
        xarray.open_dataset(video, engine=AcquireBackend, group="a")


def test_a_growing_recording_is_consistent_wherever_it_is_opened(tmp_path: Path) -> None:
    """After every block, committed or not, zarr, xarray and the engine find only complete rows."""
    path, code, clock = tmp_path / "grows.zarr", PrbsCode(15, 77), ClockFit(90_000_000, 10**18, 100)
    camera = {"white_dn": 255, "black_level_dn": 1.0, "responsivity_dn": 2.0}
    spec = RecordingSpec(
        run_id="run-1", stages=6, substeps=2, pixels=6, dtype="uint8", first_line=FIRST, clock=clock,
        code=code.to_attrs(), substep_ticks=900, trigger={"model": "test"}, config={},
        cameras={"a": camera, "b": camera}, chunk_lines=16, shard_chunks=2,
    )  # fmt: skip
    tagger = Tagger(TriggerRun("run-1", code, 2, 900, 1), 6, clock)
    seen = []
    with RecordingWriter.create(path, spec) as writer:
        for number in range(8):
            first = FIRST + 12 * number
            pixels = np.repeat(np.arange(first, first + 12, dtype=np.uint8)[:, None], 6, axis=1)
            for arm in ARMS:
                writer.append(tagger.tag(arm, LineBlock(first, pixels, np.zeros(12, np.uint16))))
            if number % 2:
                writer.commit()
            seen.append(_rows(path))
        writer.seal(RunCondition.GOOD, "stopped", {})
    assert seen == sorted(seen)
    assert (seen[0], seen[-1], _rows(path)) == (0, 96, 96)


def _rows(path: Path) -> int:
    """Return the number of rows on which all readers agree, each with its own line."""
    lengths = set()
    group = zarr.open_group(path, mode="r")
    with xarray.open_dataset(path, engine=AcquireBackend, group="b") as dataset:
        lengths.add(dataset.sizes["line"])
        np.testing.assert_array_equal(dataset["lines"][:, 2], dataset["line"].values.astype(np.uint8))
        np.testing.assert_array_equal(dataset["code_index"], 2 * dataset["line"])
    for arm in ARMS:
        with xarray.open_zarr(path, group=arm, chunks=None) as dataset:
            assert dataset["lines"].shape[0] == dataset["flags"].shape[0]
        lines = group[f"{arm}/lines"][:]
        np.testing.assert_array_equal(lines[:, 0], np.arange(FIRST, FIRST + len(lines), dtype=np.uint8))
        lengths.add(len(lines))
    (length,) = lengths
    return length
