"""Videos as OME-Zarr 0.5, read by zarr-python and xarray."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.errors import DataError, PlaceError, UsageError
from acquire.store import open_video, write_video

TIME = np.int64(1_790_000_000_000_000_000)


def make(frames=5, side=6, dtype="float32"):
    generator = np.random.default_rng(1)
    video = generator.integers(0, 250, (frames, side, side)).astype(dtype)
    return video, TIME + np.arange(frames, dtype=np.int64) * 30_000


@settings(max_examples=12, deadline=None)
@given(st.integers(1, 40), st.integers(1, 300), st.sampled_from(["float32", "uint8", "uint16"]))
def test_video_reads_back(tmp_path_factory, frames, side, dtype):
    path = tmp_path_factory.mktemp("v") / "v.zarr"
    video, time_ns = make(frames, side, dtype)
    write_video(path, video, time_ns, 5.0, 30_000.0, {"recording": "r.zarr", "preset": "fast"})
    file = open_video(path)
    np.testing.assert_array_equal(file.video[:], video)
    assert file.video.dtype == video.dtype
    np.testing.assert_array_equal(file.time_ns, time_ns)
    assert file.attrs["provenance"] == {"recording": "r.zarr", "preset": "fast"}
    assert [p.name for p in path.parent.iterdir()] == ["v.zarr"]


def test_metadata_is_ome_zarr_0_5(tmp_path):
    path = tmp_path / "v.zarr"
    write_video(path, *make(), 5.0, 30_000.0, {})
    ome = json.loads((path / "zarr.json").read_bytes())["attributes"]["ome"]
    assert ome["version"] == "0.5"
    (image,) = ome["multiscales"]
    assert [(axis["name"], axis["type"], axis["unit"]) for axis in image["axes"]] == [
        ("t", "time", "second"),
        ("y", "space", "micrometer"),
        ("x", "space", "micrometer"),
    ]
    (dataset,) = image["datasets"]
    array = zarr.open_group(path, mode="r")[dataset["path"]]
    assert array.metadata.dimension_names == ("t", "y", "x")
    (transformation,) = dataset["coordinateTransformations"]
    assert transformation["type"] == "scale"
    assert transformation["scale"] == pytest.approx([30e-6, 5.0, 5.0])


def test_without_a_known_pixel_size_space_has_no_unit(tmp_path):
    write_video(tmp_path / "v.zarr", *make(), 1.0, 30_000.0, {}, pixel_unit=None)
    axes = open_video(tmp_path / "v.zarr").attrs["ome"]["multiscales"][0]["axes"]
    assert [axis.get("unit") for axis in axes] == ["second", None, None]


def test_xarray_opens_a_video(tmp_path):
    video, time_ns = make()
    write_video(tmp_path / "v.zarr", video, time_ns, 5.0, 30_000.0, {})
    with xarray.open_zarr(tmp_path / "v.zarr", chunks=None) as dataset:
        assert dataset["0"].dims == ("t", "y", "x")
        np.testing.assert_array_equal(dataset["time"].values.astype(np.int64), time_ns)


def test_an_existing_path_is_refused(tmp_path):
    path = tmp_path / "v.zarr"
    path.mkdir()
    with pytest.raises(UsageError, match="exists already"):
        write_video(path, *make(), 5.0, 30_000.0, {})
    assert not list(path.iterdir())


@pytest.mark.parametrize(
    "wrong",
    [
        {"video": np.zeros((5, 6), np.float32)},
        {"video": np.zeros((5, 6, 6), np.complex64)},
        {"video": np.zeros((0, 6, 6), np.float32)},
        {"time_ns": np.arange(4)},
        {"time_ns": np.arange(5.0)},
        {"pixel_size": 0.0},
        {"frame_interval_ns": float("inf")},
        {"provenance": {"x": np.float32(1)}},
    ],
)
def test_what_cannot_be_written_is_refused_untouched(tmp_path, wrong):
    video, time_ns = make()
    asked = {
        "video": video,
        "time_ns": time_ns,
        "pixel_size": 1.0,
        "frame_interval_ns": 1.0,
        "provenance": {},
    }
    with pytest.raises(UsageError):
        write_video(tmp_path / "v.zarr", **{**asked, **wrong})
    assert not list(tmp_path.iterdir())


def test_what_is_not_a_video_says_so(tmp_path):
    with pytest.raises(PlaceError, match="does not exist"):
        open_video(tmp_path / "v.zarr")
    with pytest.raises(PlaceError, match="not a video"):
        open_video(tmp_path)
    zarr.create_group(tmp_path / "g.zarr")
    with pytest.raises(PlaceError, match="not a video"):
        open_video(tmp_path / "g.zarr")


def test_a_pipe_in_the_place_of_a_video_keeps_nobody_waiting(tmp_path):
    (tmp_path / "v.zarr").mkdir()
    os.mkfifo(tmp_path / "v.zarr" / "zarr.json")
    with pytest.raises(DataError, match="it is a pipe, not a file"):
        open_video(tmp_path / "v.zarr")
