"""``acquire export``: its files, opened with the usual libraries."""

from __future__ import annotations

import errno
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest
import tifffile
from small_files import noise_video, run_with_small_files

from acquire.exchange import (
    arrays,
    export,
    from_recording,
    movie,
    recording_content,
    tiff,
    video_content,
)
from acquire.lines import LineFlag
from acquire.store import open_recording, open_video, write_video
from acquire.store.present import flags_of

FIRST, M, S, TRUSTED = 100, 6, 2, range(3, 17)
Cli = Callable[..., tuple[int, str, str]]


def test_imagej_has_axes_interval_and_pixel_size(cli: Cli, video: Path, tmp_path: Path) -> None:
    assert cli("export", video, tmp_path / "v.tif")[0] == 0
    with tifffile.TiffFile(tmp_path / "v.tif") as file:
        (series,) = file.series
        assert (series.axes, series.shape) == ("TYX", (14, 7, 5))
        np.testing.assert_array_equal(series.asarray(), open_video(video).video[3:17])
        facts = file.imagej_metadata
        assert facts is not None
        assert (facts["finterval"], facts["unit"], facts["frames"]) == (pytest.approx(1e-5), "um", 14)
        assert json.loads(facts["Info"])["frames"] == [3, 17]
        above, below = file.pages[0].tags["XResolution"].value
        assert above / below == pytest.approx(1 / 2.5)
    assert [path.name for path in tmp_path.iterdir()] == ["v.tif"]


def test_ome_tiff_has_the_same_metadata(cli: Cli, video: Path, tmp_path: Path) -> None:
    assert cli("export", video, tmp_path / "v.ome.tif")[0] == 0
    with tifffile.TiffFile(tmp_path / "v.ome.tif") as file:
        assert file.is_bigtiff
        assert file.series[0].axes == "TYX"
        np.testing.assert_array_equal(file.asarray(), open_video(video).video[3:17])
        image = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
    pixels, began = image["Pixels"], np.datetime64(int(open_video(video).time_ns[3]), "ns")
    assert np.datetime64(str(image["AcquisitionDate"]).removesuffix("Z")) == began.astype("datetime64[s]")
    assert (pixels["PhysicalSizeX"], pixels["PhysicalSizeXUnit"]) == (2.5, "µm")
    assert float(pixels["TimeIncrement"]) == pytest.approx(1e-5)


def test_nexus_plots_the_video_by_default(cli: Cli, video: Path, tmp_path: Path) -> None:
    assert cli("export", video, tmp_path / "v.nxs", "--all-frames")[0] == 0
    with h5py.File(tmp_path / "v.nxs") as file:
        entry = file[file.attrs["default"]]
        data = entry[entry.attrs["default"]]
        assert (entry.attrs["NX_class"], data.attrs["NX_class"]) == ("NXentry", "NXdata")
        signal, axes = data[data.attrs["signal"]], list(data.attrs["axes"])
        np.testing.assert_array_equal(signal, open_video(video).video[:])
        assert axes == ["time", "y", "x"]
        assert [len(data[name]) for name in axes] == list(signal.shape)
        np.testing.assert_allclose(data["time"], np.arange(20) * 1e-5)
        assert [data[name].attrs["units"] for name in axes] == ["s", "um", "um"]
        np.testing.assert_allclose(data["x"], np.arange(5) * 2.5)
        np.testing.assert_array_equal(data["time_ns"], open_video(video).time_ns)
        assert [data.attrs[f"{name}_indices"].tolist() for name in ("time_ns", "trusted")] == [[0], [0]]
        np.testing.assert_array_equal(np.flatnonzero(data["trusted"]), TRUSTED)
        facts = json.loads(entry["process/note/data"][()])
    assert facts["trusted_frames"] == [3, 17]
    assert facts["provenance"]["recording"] == "run.zarr"


IN_WORDS = "about 4 % of full scale (2 to 10 % in nine of ten)"


def test_the_estimated_error_of_a_video_is_exported(cli: Cli, told: Path, tmp_path: Path) -> None:
    source = open_video(told)
    assert source.error is not None
    error, frames = source.error[3:17], source.video[3:17]
    for name in ("v.ome.tif", "v.h5", "v.npz"):
        assert cli("export", told, tmp_path / name)[2] == ""
    with tifffile.TiffFile(tmp_path / "v.ome.tif") as file:
        for series, values in zip(file.series, (frames, error), strict=True):
            np.testing.assert_array_equal(series.asarray(), values)
        images = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
        assert [image["Name"] for image in images] == [str(told), "error"]
        assert json.loads(images[0]["Description"])["estimated_error"] == IN_WORDS
        assert "NaN if no estimate is possible" in images[1]["Description"]
    with h5py.File(tmp_path / "v.h5") as file:
        data, beside = file["entry/data"], file["entry/error"]
        np.testing.assert_array_equal(beside[beside.attrs["signal"]], error)
        assert beside.attrs["NX_class"] == "NXdata"
        assert list(beside.attrs["axes"]) == ["time", ".", "."]
        assert beside["time"] == data["time"]
        np.testing.assert_array_equal(data["quality"], source.quality[3:17])
        assert json.loads(file["entry/process/note/data"][()])["provenance"]["error"]["rms"] == 0.02
    with np.load(tmp_path / "v.npz") as saved:
        np.testing.assert_array_equal(saved["error"], error)
        assert json.loads(str(saved["facts"]))["estimated_error"] == IN_WORDS


def test_formats_without_room_for_the_error_are_reported(cli: Cli, told: Path, tmp_path: Path) -> None:
    for name in ("v.mp4", "v.npy", "v.tif"):
        assert (
            f"{name} does not hold the estimated error of the regions"
            in cli("export", told, tmp_path / name)[2]
        )
    _, out, _ = cli("export", told, tmp_path / "w.mp4", "--json")
    assert json.loads(out)["left_out"] == ["error"]
    with av.open(str(tmp_path / "v.mp4")) as file:
        facts = json.loads(file.metadata["comment"])
    assert (facts["estimated_error"], facts["left_out"]) == (IN_WORDS, ["error"])
    with tifffile.TiffFile(tmp_path / "v.tif") as file:
        assert file.imagej_metadata is not None
        assert json.loads(file.imagej_metadata["Info"])["estimated_error"] == IN_WORDS
        assert len(file.pages) == 14  # readers that do not know ImageJ's count them


def test_frames_that_are_not_trusted_are_left_out_or_named(cli: Cli, video: Path, tmp_path: Path) -> None:
    code, out, err = cli("export", video, tmp_path / "a.npy")
    assert (code, err, np.load(tmp_path / "a.npy").shape) == (0, "", (14, 7, 5))
    assert "14 × 7 × 5 (time, y, x)" in out
    code, _, err = cli("export", video, tmp_path / "b.npy", "--all-frames")
    assert (code, np.load(tmp_path / "b.npy").shape) == (0, (20, 7, 5))
    assert "6 of 20 frames are not trusted" in err
    code, _, err = cli("export", video, tmp_path / "c.npy", "--frames", 3)
    assert (code, "frames 3 to 16" in err, "--all-frames" in err) == (2, True, True)
    assert cli("export", video, tmp_path / "c.npz", "--frames", 8)[0] == 0
    with np.load(tmp_path / "c.npz") as saved:
        np.testing.assert_array_equal(saved["video"], open_video(video).video[3:8])
        np.testing.assert_array_equal(saved["trusted"], np.ones(5))
        assert json.loads(str(saved["facts"]))["frames"] == [3, 8]


SUFFIXES = (".tif", ".ome.tif", ".h5", ".npz", ".mp4")


@pytest.mark.parametrize("reached", [0, 3])
def test_a_movie_is_black_where_no_tile_was_reached(tmp_path: Path, reached: int) -> None:
    frames, time_ns = np.full((4, 8, 6), 2.0, np.float32), np.arange(4, dtype=np.int64)
    frames[:, :, reached:] = np.nan
    write_video(
        tmp_path / "v.zarr",
        frames,
        time_ns,
        pixel_size=1.0,
        frame_interval_ns=1,
        provenance={"trusted": [0, 0]},
    )
    export(video_content(open_video(tmp_path / "v.zarr"), "v", whole=True), tmp_path / "v.mp4")
    with av.open(str(tmp_path / "v.mp4")) as file:
        shown = next(file.decode(video=0)).to_ndarray(format="gray")
    if reached:
        assert shown[:, : shown.shape[1] // 2 - 8].mean() > 240
    assert shown[:, shown.shape[1] // 2 + 8 :].mean() < 16


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(("frames", "trusted"), [(range(3), [3, 3]), (range(18, 20), [0, 0])])
def test_frames_of_which_none_is_trusted_are_written(
    video: Path, tmp_path: Path, frames: range, trusted: list[int], suffix: str
) -> None:
    content = video_content(open_video(video), "v", frames, whole=True)
    assert (content.facts["trusted_frames"], content.untrusted) == (trusted, len(frames))
    assert export(content, tmp_path / f"v{suffix}") > 0


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_odd_names_and_units_are_escaped_where_a_format_cannot_hold_them(tmp_path: Path, suffix: str) -> None:
    frames, time_ns = np.ones((3, 7, 5), np.float32), np.arange(3, dtype=np.int64)
    write_video(
        tmp_path / "video.zarr",
        frames,
        time_ns,
        pixel_size=2.5,
        frame_interval_ns=1,
        provenance={},
        pixel_unit="µm",
    )
    out = tmp_path / f"Gerät 1{suffix}"
    assert export(video_content(open_video(tmp_path / "video.zarr"), "caf\udce9 \x01é"), out) > 0
    if suffix == ".tif":
        with tifffile.TiffFile(out) as file:
            assert file.imagej_metadata is not None
            assert file.imagej_metadata["unit"] == r"\u00B5m"
    elif suffix == ".ome.tif":
        with tifffile.TiffFile(out) as file:
            image = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
        assert (image["Name"], image["Pixels"]["PhysicalSizeXUnit"]) == (r"caf\udce9 \x01é", "µm")


def test_times_choose_frames(cli: Cli, video: Path, tmp_path: Path) -> None:
    utc = "2023-11-14T22:13:20.000120"  # 12 frames after the first
    assert cli("export", video, tmp_path / "v.npz", "--from", "50us", "--to", utc)[0] == 0
    with np.load(tmp_path / "v.npz") as saved:
        np.testing.assert_array_equal(saved["time_ns"], open_video(video).time_ns[5:12])


@pytest.mark.parametrize(("usual_side", "times"), [(256, 36), (7, 1)])
def test_a_movie_shows_what_the_video_holds(
    cli: Cli, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, usual_side: int, times: int
) -> None:
    monkeypatch.setattr(movie, "USUAL_SIDE", usual_side)
    assert cli("export", video, tmp_path / "v.mp4", "--peak", 1, "--fps", 10)[0] == 0
    with av.open(str(tmp_path / "v.mp4")) as file:
        assert file.streams.video[0].average_rate == 10
        frames = np.stack([frame.to_ndarray(format="gray") for frame in file.decode(video=0)])
        facts = json.loads(file.metadata["comment"])
    assert frames.shape == (14, *(side * times + side * times % 2 for side in (7, 5)))
    middle = frames[:, times // 2 :: times, times // 2 :: times][:, :7, :5]
    error = middle / 255 - open_video(video).video[3:17]
    assert np.sqrt(np.mean(error**2)) < (0.02 if times > 1 else 0.1)  # fine noise is lost in coding
    assert (facts["white"], facts["frames"], facts["enlarged"]) == (1.0, [3, 17], times)


@pytest.mark.parametrize("column", [0, 5, 17])
def test_white_is_found_wherever_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, column: int) -> None:
    frames, time_ns = np.full((2, 64, 32), 0.01, np.float32), np.arange(2, dtype=np.int64)
    frames[:, :, column] = 1
    write_video(tmp_path / "video.zarr", frames, time_ns, pixel_size=2.5, frame_interval_ns=1, provenance={})
    monkeypatch.setattr(movie, "SAMPLED", 2 * 64 * 2)  # every 16th voxel: of two columns of 32
    export(video_content(open_video(tmp_path / "video.zarr"), "v"), tmp_path / "v.mp4")
    with av.open(str(tmp_path / "v.mp4")) as file:
        assert json.loads(file.metadata["comment"])["white"] == 1.0


@pytest.mark.parametrize("block_bytes", [200, 2**23])
def test_lines_and_tags_of_a_recording(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int
) -> None:
    monkeypatch.setattr(from_recording, "BLOCK_BYTES", block_bytes)
    opened = open_recording(recording)
    content = recording_content(opened, range(20, 60))
    export(content, tmp_path / "l.h5")
    export(content, tmp_path / "l.npz")
    export(content, tmp_path / "l.tif")
    cut = opened.cut(FIRST + 20, 40)
    with h5py.File(tmp_path / "l.h5") as file:
        data = file["entry/data"]
        np.testing.assert_array_equal(data["lines"], cut.lines)
        assert list(data.attrs["axes"]) == [".", "line", "pixel"]
        np.testing.assert_array_equal(data["line"], np.arange(FIRST + 20, FIRST + 60))
    with np.load(tmp_path / "l.npz") as saved:
        np.testing.assert_array_equal(saved["lines"], cut.lines)
        np.testing.assert_array_equal(saved["time_ns"], cut.time_ns)
        np.testing.assert_array_equal(saved["code_index"], S * np.arange(FIRST + 20, FIRST + 60))
        bits = np.unpackbits(saved["code"][:, None], axis=1, bitorder="little")[:, :S].reshape(-1)
        np.testing.assert_array_equal(bits, cut.code[: len(bits)])
        missing = (saved["flags"] & LineFlag.MISSING) != 0
        assert [np.flatnonzero(arm).tolist() for arm in missing] == [[], [*range(10, 15)]]
        facts = json.loads(str(saved["facts"]))
    assert (facts["first_line"], facts["run_condition"], facts["code"]["state"]) == (
        120,
        "INCOMPLETE",
        "0x4d",
    )
    with tifffile.TiffFile(tmp_path / "l.tif") as file:
        assert file.series[0].axes == "CYX"
        np.testing.assert_array_equal(file.asarray(), cut.lines)


@pytest.mark.parametrize("block_bytes", [200, 2**23])
def test_an_overview_is_the_mean_of_the_lines_that_are_there(
    cli: Cli, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int
) -> None:
    monkeypatch.setattr(from_recording, "BLOCK_BYTES", block_bytes)
    assert cli("export", recording, tmp_path / "o.h5", "--average", 4, "--first-line", 128)[0] == 0
    whole = open_recording(recording).cut(128, 62)
    lines, mask = whole.lines.astype(float), np.ones((2, 62), bool)
    mask[1, 2:7] = False
    with h5py.File(tmp_path / "o.h5") as file:
        data = file["entry/data"]
        assert (data["lines"].shape, data["lines"].dtype) == ((2, 16, M), np.float32)
        for arm in range(2):
            for row in range(16):
                part = slice(4 * row, min(62, 4 * row + 4))
                there = lines[arm, part][mask[arm, part]]
                np.testing.assert_allclose(data["lines"][arm, row], there.mean(axis=0), rtol=1e-6)
        np.testing.assert_array_equal(data["line"], np.arange(128, 190, 4))
        np.testing.assert_array_equal(data["time_ns"], whole.time_ns[::4])
        assert not data["flags"][:].any()  # a line of each group is there
        assert "code" not in data
    code, _, err = cli("export", recording, tmp_path / "p.npz", "--average", 5, "--first-line", 130)
    with np.load(tmp_path / "p.npz") as saved:
        missing = (saved["flags"] & LineFlag.MISSING) != 0
        assert (code, [np.flatnonzero(arm).tolist() for arm in missing]) == (0, [[], [0]]), err
        assert not saved["lines"][1, 0].any()


@pytest.mark.parametrize("step", [40, 90, 1000])
def test_an_overview_does_not_read_a_long_group_of_lines_at_once(
    recording: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    opened, most, read = open_recording(recording), 7, []
    content = recording_content(opened, range(2, 90, step))

    def exported() -> list[Any]:
        arrays = (content.image, *content.columns)
        return [np.concatenate([values for _, values in array.blocks()]) for array in arrays]

    at_once = exported()

    def observed(opened: Any, arm: str, start: int, stop: int) -> Any:
        read.append(stop - start)
        return flags_of(opened, arm, start, stop)

    monkeypatch.setattr(from_recording, "BLOCK_BYTES", most * 2 * M)
    monkeypatch.setattr(from_recording, "flags_of", observed)
    for in_parts, whole in zip(exported(), at_once, strict=True):
        np.testing.assert_array_equal(in_parts, whole)
    assert max(read) <= most


def test_damaged_lines_are_left_out_of_averages() -> None:
    damaged, missing = LineFlag.INCOMPLETE, LineFlag.MISSING
    lines = np.repeat(np.arange(1, 9, dtype=np.uint16)[:, None], 3, axis=1)
    flags = np.array([LineFlag.SATURATED, damaged, 0, 0, damaged, damaged, missing, damaged], np.uint16)
    means = from_recording._groups("lines", lines, flags, 2)
    np.testing.assert_array_equal(means, np.repeat([[1.0], [3.5], [0.0], [0.0]], 3, axis=1))
    assert from_recording._groups("flags", flags, flags, 2).tolist() == [
        LineFlag.SATURATED, 0, damaged, missing | damaged,
    ]  # fmt: skip


def test_times_choose_lines(cli: Cli, recording: Path, tmp_path: Path) -> None:
    assert cli("export", recording, tmp_path / "l.npz", "--from", "200us", "--to", "0.4ms")[0] == 0
    with np.load(tmp_path / "l.npz") as saved:
        np.testing.assert_array_equal(saved["code_index"], S * np.arange(FIRST + 10, FIRST + 20))
    code, _, err = cli("export", recording, tmp_path / "m.npz", "--from", "1ms", "--to", "3s")
    assert (code, "0ms to 1.8ms after the first" in err) == (2, True)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "l.xyz"], "possible: .tif (ImageJ)"),
        (["run", "l.mp4"], "whose lines are not pictures"),
        (["run", "l.npy", "--frames", 3], "a recording has no frames"),
        (["video", "v.npy", "--lines", 3], "a video has no lines"),
        (["video", "v.npy", "--average", 3], "a video has no lines"),
        (["run", "l.npy", "--lines", 300], "possible: lines 100 to 189"),
        (["run", "l.npy", "--lines", 0], "1 or more"),
        (["run", "l.npy", "--lines", 5, "--to", "1ms"], "given twice"),
        (["video", "v.npy", "--first-frame", 19, "--frames", 2], "possible: 0 to 19"),
        (["video", "v.npy", "--first-frame", 99], "does not have frame 99"),
        (["video", "v.mp4", "--fps", 0], "0.1 to 240"),
        (["video", "v.mp4", "--peak", -1], "above 0"),
        (["nothing", "v.npy"], "does not exist"),
        (["video", "no/v.npy"], "does not exist"),
        (["video", "."], "cannot be taken from its name"),
        (["video", ".."], "cannot be taken from its name"),
    ],
)
def test_impossible_requests_are_refused_and_nothing_is_changed(
    cli: Cli,
    recording: Path,
    video: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: list[Any],
    said: str,
) -> None:
    source = {"run": recording, "video": video}.get(words[0], tmp_path / "absent.zarr")
    monkeypatch.chdir(tmp_path)
    code, _, err = cli("export", source, words[1], *words[2:])
    assert (code, said in err) == (2, True), err
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten(cli: Cli, video: Path, tmp_path: Path) -> None:
    (tmp_path / "v.npy").write_text("precious")
    assert cli("export", video, tmp_path / "v.npy")[0] == 2
    assert (tmp_path / "v.npy").read_text() == "precious"


@pytest.mark.parametrize(("module", "name"), [("tifffile", "v.tif"), ("h5py", "v.h5"), ("av", "v.mp4")])
def test_a_library_that_is_missing_is_named_with_its_extra(
    cli: Cli, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, name: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    code, _, err = cli("export", video, tmp_path / name)
    extra = "video" if module == "av" else "export"
    assert (code, f"pip install 'tdi-acquire[{extra}]'" in err) == (2, True)
    assert not list(tmp_path.iterdir())


def test_an_image_too_large_for_imagej_suggests_ome(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Cli
) -> None:
    monkeypatch.setattr(tiff, "MOST_BYTES", 100)
    code, _, err = cli("export", video, tmp_path / "v.tif")
    assert (code, "NAME.ome.tif" in err) == (2, True)
    assert cli("export", video, tmp_path / "v.ome.tif")[0] == 0


def test_a_full_disk_leaves_nothing(video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(arrays.npy, "write_array_header_1_0", full)
    with pytest.raises(Exception, match="No space left"):
        export(video_content(open_video(video), "v"), tmp_path / "v.npy")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("most_bytes", [0, 3000, 20_000])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_disk_that_takes_no_more_is_an_error_and_not_the_end_of_the_process(
    tmp_path: Path, suffix: str, most_bytes: int
) -> None:
    """HDF5 itself crashes when it closes a file that it cannot write."""
    video = noise_video(tmp_path / "v.zarr")
    done = run_with_small_files(most_bytes, "export", video, tmp_path / f"v{suffix}")
    assert (done.returncode, "File too large" in done.stderr) == (5, True), done.stderr
    assert "Traceback" not in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["v.zarr"]
