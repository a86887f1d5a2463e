"""Data for napari: layers that are read when they are displayed. napari itself is not needed."""

from __future__ import annotations

import importlib
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from acquire.errors import UsageError
from acquire.exchange import lazy
from acquire.exchange.lazy import Stack
from acquire.exchange.napari_reader import reader_for
from acquire.store import open_recording, open_video, write_video

ROOT = Path(__file__).parents[2]


def test_the_manifest_leads_to_the_reader() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    name = tomllib.loads(text)["project"]["entry-points"]["napari.manifest"]["tdi-acquire"]
    package, _, file = name.partition(":")
    found = importlib.import_module(package).__file__
    assert found is not None
    manifest = tomllib.loads((Path(found).parent / file).read_text(encoding="utf-8"))
    (command,) = manifest["contributions"]["commands"]
    (reader,) = manifest["contributions"]["readers"]
    assert reader["command"] == command["id"]
    assert command["id"].startswith(manifest["name"] + ".")
    module, _, function = command["python_name"].partition(":")
    assert getattr(importlib.import_module(module), function) is reader_for


def test_a_video_is_its_trusted_frames_at_their_place(video: Path) -> None:
    read = reader_for(str(video))
    assert read is not None
    ((data, options, kind),) = read(str(video))
    whole = open_video(video).video[:]
    assert (kind, data.shape, data.ndim, data.dtype) == ("image", (14, 7, 5), 3, np.float32)
    np.testing.assert_array_equal(data[2], whole[5])
    np.testing.assert_array_equal(data[(np.int64(2), slice(1, 4), slice(None))], whole[5, 1:4])
    np.testing.assert_array_equal(data[(slice(3, 6), 1)], whole[6:9, 1])
    np.testing.assert_array_equal(data[-1], whole[16])
    np.testing.assert_array_equal(np.asarray(data), whole[3:17])
    assert options["name"] == "video (frames 3 to 16)"
    assert options["scale"] == pytest.approx([1e-5, 2.5, 2.5])
    assert options["translate"] == pytest.approx([3e-5, 0.0, 0.0])
    low, high = options["contrast_limits"]
    assert whole.min() <= low < high <= whole.max()


@pytest.mark.parametrize(
    ("provenance", "words"), [({}, "not known"), ({"trusted": [2, 2]}, "no frame is trusted")]
)
def test_a_video_without_trusted_frames_is_reported(tmp_path: Path, provenance: object, words: str) -> None:
    frames, times = np.zeros((4, 3, 3), np.float32), np.arange(4, dtype=np.int64)
    write_video(
        tmp_path / "v.zarr", frames, times, pixel_size=1.0, frame_interval_ns=1.0, provenance=provenance
    )  # type: ignore[arg-type]
    read = reader_for(str(tmp_path / "v.zarr"))
    assert read is not None
    ((data, options, _),) = read(str(tmp_path / "v.zarr"))
    assert (len(data), words in options["name"]) == (4, True)


def test_a_recording_is_pages_of_both_arms(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lazy, "PAGE_LINES", 40)
    read = reader_for(str(recording))
    assert read is not None
    layers = read(str(recording))
    opened = open_recording(recording)
    arms = layers[2:]
    assert [options["name"] for _, options, _ in arms] == ["run, arm a", "run, arm b"]
    assert [options["translate"] for _, options, _ in arms] == [[0, 0, 0], [0, 0, 14]]
    for (data, options, _), arm in zip(layers[:2], "ab", strict=True):
        overview = opened.overview(arm)
        assert overview is not None
        np.testing.assert_array_equal(data, overview.rows)
        assert options["name"] == f"run, arm {arm}, overview (64 lines a row)"
        assert (options["translate"], options["visible"]) == ([0, 0 if arm == "a" else 14], False)
    for (data, _, _), arm in zip(arms, "ab", strict=True):
        lines = opened.camera(arm).lines[:]
        assert data.shape == (3, 40, 6)
        np.testing.assert_array_equal(data[1], lines[40:80])
        np.testing.assert_array_equal(data[2, :10], lines[80:])
        assert not data[2, 10:].any()


def test_only_displayed_data_are_read(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lazy, "PAGE_LINES", 10)
    monkeypatch.setattr(lazy, "MOST_BYTES", 300)
    read_rows = []
    present = lazy.present_values

    def counted(*words: object) -> object:
        read_rows.append(words[3])
        return present(*words)  # type: ignore[arg-type]

    monkeypatch.setattr(lazy, "present_values", counted)
    stack = lazy.pages(open_recording(recording), "a")
    stack[7]
    assert read_rows == [70]
    with pytest.raises(UsageError, match="9 pictures at once would be 1080 bytes"):
        stack[:]
    assert read_rows == [70]


@pytest.mark.parametrize(
    "index", [np.s_[...], np.s_[..., 2], np.s_[..., 1:, ::2], np.s_[1:3, ..., 0], np.s_[:, 4], np.s_[-1], ()]
)
def test_pictures_are_sliced_like_an_array(index: Any) -> None:
    pictures = np.arange(6 * 5 * 4).reshape(6, 5, 4)
    stack = Stack(pictures.shape, pictures.dtype, lambda number: pictures[number])
    np.testing.assert_array_equal(stack[index], pictures[index])


def test_foreign_files_are_left_to_other_readers(tmp_path: Path) -> None:
    zarr.create_group(tmp_path / "g.zarr")
    (tmp_path / "bad.zarr").mkdir()
    (tmp_path / "bad.zarr" / "zarr.json").write_text(json.dumps([]))
    for path in (tmp_path / "g.zarr", tmp_path / "bad.zarr", tmp_path / "absent.zarr"):
        assert reader_for(str(path)) is None
    assert reader_for([str(tmp_path / "g.zarr")]) is None
