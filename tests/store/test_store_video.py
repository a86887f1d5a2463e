"""Videos as OME-Zarr 0.5, read by zarr-python and xarray."""

from __future__ import annotations

import errno
import json
import os
import shutil

import numpy as np
import ome_zarr_models.v05
import pytest
import xarray
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from ome_zarr_models.common.omero import Omero

from acquire.errors import DataError, PlaceError, StoreError, UsageError
from acquire.store import MosaicWriter, open_video, video_layout, video_writer, write_video

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
    write_video(
        path,
        video,
        time_ns,
        pixel_size=5.0,
        frame_interval_ns=30_000.0,
        provenance={"recording": "r.zarr", "preset": "fast"},
    )
    file = open_video(path)
    np.testing.assert_array_equal(file.video[:], video)
    assert file.video.dtype == video.dtype
    np.testing.assert_array_equal(file.time_ns, time_ns)
    assert file.attrs["provenance"] == {"recording": "r.zarr", "preset": "fast"}
    assert [p.name for p in path.parent.iterdir()] == ["v.zarr"]


def test_metadata_is_ome_zarr_0_5(tmp_path):
    path = tmp_path / "v.zarr"
    write_video(path, *make(), pixel_size=5.0, frame_interval_ns=30_000.0, provenance={})
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
    scale, translation = dataset["coordinateTransformations"]
    assert (scale["type"], translation["type"]) == ("scale", "translation")
    assert scale["scale"] == pytest.approx([30e-6, 5.0, 5.0])
    assert translation["translation"] == [0.0, 0.0, 0.0]


def test_without_a_known_pixel_size_space_has_no_unit(tmp_path):
    write_video(
        tmp_path / "v.zarr",
        *make(),
        pixel_size=1.0,
        frame_interval_ns=30_000.0,
        provenance={},
        pixel_unit=None,
    )
    axes = open_video(tmp_path / "v.zarr").attrs["ome"]["multiscales"][0]["axes"]
    assert [axis.get("unit") for axis in axes] == ["second", None, None]


def test_xarray_has_times_and_places_as_coordinates(tmp_path):
    video, time_ns = make()
    origin = (0.5, 2.0, 2.0)
    provenance = {"trusted": [1, 4]}
    write_video(
        tmp_path / "v.zarr",
        video,
        time_ns,
        pixel_size=5.0,
        frame_interval_ns=30_000.0,
        provenance=provenance,
        origin=origin,
    )
    with xarray.open_zarr(tmp_path / "v.zarr", chunks=None, consolidated=False) as dataset:
        image = dataset["0"]
        assert image.dims == ("t", "y", "x")
        assert set(image.coords) == {"t", "y", "x", "time", "trusted"}
        np.testing.assert_array_equal(image["time"].values.astype(np.int64), time_ns)
        np.testing.assert_allclose(image["t"], 0.5 + np.arange(5) * 30e-6)
        np.testing.assert_array_equal(image.sel(y=7.0, x=12.0), video[:, 1, 2])
        np.testing.assert_array_equal(image[image["trusted"]], video[1:4])
        moment = np.datetime64(int(time_ns[3]), "ns")
        np.testing.assert_array_equal(image.swap_dims(t="time").sel(time=moment), video[3])
    with xarray.open_zarr(tmp_path / "v.zarr", chunks=None) as dataset:
        assert list(dataset) == ["0"]


def test_viewers_that_take_all_arrays_of_a_group_find_the_image_alone(tmp_path):
    """As napari's own reader does: the groups of a group, or else all of its arrays, are levels."""
    write_video(
        tmp_path / "v.zarr",
        *make(),
        pixel_size=5.0,
        frame_interval_ns=30_000.0,
        provenance={"trusted": [0, 5]},
    )
    group = zarr.open(tmp_path / "v.zarr", mode="r")
    assert (list(group.group_keys()), sorted(group.array_keys())) == ([], ["0"])


def test_the_validator_of_ome_zarr_is_content(tmp_path):
    write_video(
        tmp_path / "v.zarr",
        *make(),
        pixel_size=5.0,
        frame_interval_ns=30_000.0,
        provenance={"trusted": [2, 4]},
        origin=(0.1, 2.0, 2.0),
    )
    group = zarr.open_group(tmp_path / "v.zarr", mode="r")
    image = ome_zarr_models.v05.Image.from_zarr(group)
    assert [axis.name for axis in image.attributes.ome.multiscales[0].axes] == ["t", "y", "x"]
    channels = Omero.model_validate(group.attrs["ome"]["omero"]).channels
    video = make()[0]
    assert (channels[0].window.min, channels[0].window.max) == (video.min(), video.max())
    assert video.min() <= channels[0].window.start < channels[0].window.end <= video.max()
    assert group.attrs["ome"]["omero"]["rdefs"]["defaultT"] == 2


def test_a_large_video_has_smaller_copies(tmp_path, monkeypatch):
    monkeypatch.setattr(video_layout, "LARGE", 8)
    video, time_ns = make(5, 21, "uint8")
    write_video(
        tmp_path / "v.zarr", video, time_ns, pixel_size=5.0, frame_interval_ns=30_000.0, provenance={}
    )
    group = zarr.open_group(tmp_path / "v.zarr", mode="r")
    assert [group[name].shape[1:] for name in sorted(group.array_keys())] == [(21, 21), (11, 11), (6, 6)]
    even = video[:, :20, :20].reshape(5, 10, 2, 10, 2).mean(axis=(2, 4))
    np.testing.assert_allclose(group["1"][:, :10, :10], even, atol=0.5)
    ome_zarr_models.v05.Image.from_zarr(group)
    datasets = group.attrs["ome"]["multiscales"][0]["datasets"]
    assert [each["coordinateTransformations"][1]["translation"][1] for each in datasets] == [0.0, 2.5, 7.5]
    np.testing.assert_array_equal(open_video(tmp_path / "v.zarr").video[:], video)


def test_what_a_viewer_shows_is_bounded_in_memory():
    window = video_layout.DisplayRange()
    generator = np.random.default_rng(3)
    for _ in range(300):
        window.add(generator.normal(10.0, 1.0, (4, 50, 50)).astype(np.float32))
    window.add(np.full((1, 2, 2), np.nan, np.float32))
    assert sum(map(len, window._kept)) <= 2 * video_layout.KEPT
    shown = window.to_omero("v", 0)["channels"][0]["window"]
    assert (shown["start"], shown["end"]) == (pytest.approx(6.9, abs=0.2), pytest.approx(13.1, abs=0.2))


def test_a_video_of_an_older_version_opens(tmp_path):
    """All its arrays were listed, and nothing beyond time and quality lay beside the image."""
    video, time_ns = make()
    path = tmp_path / "v.zarr"
    write_video(
        path, video, time_ns, pixel_size=5.0, frame_interval_ns=30_000.0, provenance={"trusted": [1, 4]}
    )
    for name in ("t", "y", "x", "trusted"):
        shutil.rmtree(path / name)
    root = json.loads((path / "zarr.json").read_bytes())
    root["consolidated_metadata"]["metadata"]["time"] = json.loads((path / "time" / "zarr.json").read_bytes())
    image = root["attributes"]["ome"]["multiscales"][0]["datasets"][0]
    del root["attributes"]["ome"]["omero"], image["coordinateTransformations"][1]
    (path / "zarr.json").write_text(json.dumps(root))
    file = open_video(path)
    np.testing.assert_array_equal(file.video[:], video)
    np.testing.assert_array_equal(file.time_ns, time_ns)
    assert (file.origin, file.trusted, file.scale[1]) == ((0.0, 0.0, 0.0), range(1, 4), 5.0)


def test_an_existing_path_is_refused(tmp_path):
    path = tmp_path / "v.zarr"
    path.mkdir()
    with pytest.raises(UsageError, match="exists already"):
        write_video(path, *make(), pixel_size=5.0, frame_interval_ns=30_000.0, provenance={})
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
        {"quality": np.zeros(4, np.float32)},
        {"error": np.zeros((5, 8, 8), np.float32)},
        {"quality": np.zeros(5, np.float32), "error": np.zeros((4, 8, 8), np.float32)},
        {"quality": np.zeros(5, np.float32), "error": np.zeros((5, 8), np.float32)},
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


@pytest.mark.parametrize("step", ["_column", "_whole"])
def test_a_disk_that_refuses_the_first_files_is_left_as_it_was(tmp_path, monkeypatch, step):
    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(video_writer, step, refuse)
    with pytest.raises(StoreError, match="No space left"):
        write_video(tmp_path / "v.zarr", *make(), pixel_size=5.0, frame_interval_ns=30_000.0, provenance={})
    assert not list(tmp_path.iterdir())


def test_a_disk_that_refuses_a_mosaic_is_left_as_it_was(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(zarr.Array, "resize", refuse)
    with pytest.raises(StoreError, match="No space left"):
        MosaicWriter(tmp_path / "v.zarr", (2, 2), 4, video_layout.VideoGrid((1.0, 1.0, 1.0)), make()[1])
    assert not list(tmp_path.iterdir())


def test_the_remains_of_a_killed_run_with_the_same_process_number_hinder_nobody(tmp_path):
    """In a container, each run may have the same number."""
    left = tmp_path / f".v.zarr.{os.getpid()}.partial"
    zarr.create_group(left)
    write_video(tmp_path / "v.zarr", *make(), pixel_size=5.0, frame_interval_ns=30_000.0, provenance={})
    assert {path.name for path in tmp_path.iterdir()} == {"v.zarr", left.name}


def test_what_is_not_a_video_says_so(tmp_path):
    with pytest.raises(PlaceError, match="does not exist"):
        open_video(tmp_path / "v.zarr")
    with pytest.raises(PlaceError, match="not a video"):
        open_video(tmp_path)
    zarr.create_group(tmp_path / "g.zarr")
    with pytest.raises(PlaceError, match="not a video"):
        open_video(tmp_path / "g.zarr")


def scaled(*scale):
    return {
        "multiscales": [
            {
                "axes": [{}],
                "datasets": [{"coordinateTransformations": [{"type": "scale", "scale": list(scale)}]}],
            }
        ]
    }


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("ome", 5),
        ("ome", {"multiscales": []}),
        ("ome", scaled("x", 1, 1)),
        ("ome", scaled(0, 1, 1)),
        ("ome", scaled(1e999, 1, 1)),
        ("ome", scaled(1, 1)),
        ("provenance", 5),
        ("provenance", {"trusted": 5}),
        ("provenance", {"trusted": ["a", "b"]}),
        ("provenance", {"trusted": [1e999, 5]}),
        ("provenance", {"error": 5}),
        ("provenance", {"segments": 5}),
        ("provenance", {"segments": [5]}),
    ],
    ids=str,
)
def test_impossible_attributes_of_a_video_are_damage(tmp_path, key, value):
    write_video(
        tmp_path / "v.zarr",
        *make(),
        pixel_size=5.0,
        frame_interval_ns=30_000.0,
        provenance={"trusted": [1, 4]},
    )
    root = json.loads((tmp_path / "v.zarr" / "zarr.json").read_text())
    root["attributes"][key] = value
    (tmp_path / "v.zarr" / "zarr.json").write_text(json.dumps(root))
    with pytest.raises(DataError, match="is damaged"):
        open_video(tmp_path / "v.zarr")


def test_times_that_are_not_those_of_the_frames_are_damage(tmp_path):
    write_video(tmp_path / "v.zarr", *make(), pixel_size=5.0, frame_interval_ns=30_000.0, provenance={})
    zarr.open_array(tmp_path / "v.zarr" / "time").resize((3,))
    with pytest.raises(DataError, match="3 times"):
        open_video(tmp_path / "v.zarr")


def test_a_pipe_in_the_place_of_a_video_keeps_nobody_waiting(tmp_path):
    (tmp_path / "v.zarr").mkdir()
    os.mkfifo(tmp_path / "v.zarr" / "zarr.json")
    with pytest.raises(DataError, match="it is a pipe, not a file"):
        open_video(tmp_path / "v.zarr")


@pytest.mark.parametrize("times", [1, 40])
def test_black_and_white_are_those_of_all_columns(times: int) -> None:
    """Every 64th voxel of rows of 64 was one of the first column, and every other one of a half."""
    window = video_layout.DisplayRange()
    frames = np.zeros((1024, 64, 64), np.float32)
    frames[:, :, 1::2] = 1.0
    frames[:, :, 20] = 3.0
    for _ in range(times):
        window.add(frames)
    shown = window.to_omero("video", 0)["channels"][0]["window"]
    assert (shown["start"], shown["end"]) == (0.0, 3.0)
    assert sum(map(len, window._kept)) <= 2 * video_layout.KEPT
    kept = np.concatenate(window._kept)
    assert np.mean(kept == 1.0) == pytest.approx(0.5, abs=0.01)
    assert np.mean(kept == 3.0) == pytest.approx(1 / 64, abs=0.003)
