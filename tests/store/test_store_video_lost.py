"""A video of which files are gone: this is said wherever it is read, instead of showing darkness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr
from typer.testing import CliRunner

from acquire.cli import app
from acquire.errors import AcquireError, DataError
from acquire.exchange.napari_reader import read_video
from acquire.store import open_video, write_video
from acquire.store.mosaic_writer import MosaicWriter
from acquire.store.video_layout import VideoGrid
from acquire.web.archive import Archive

FRAMES, ROWS, COLUMNS = 8, 1024, 1024
"""A chunk holds four frames of bytes, or one of floats."""
TIMES = np.arange(FRAMES, dtype=np.int64) * 1000 + 5


def write(path: Path, dtype: str, value: float) -> Path:
    video = np.full((FRAMES, ROWS, COLUMNS), value, dtype)
    quality = np.zeros(FRAMES, np.float32)
    made_of = {"trusted": [0, FRAMES]}
    write_video(
        path, video, TIMES, pixel_size=1.0, frame_interval_ns=1000, provenance=made_of, quality=quality
    )
    return path


@pytest.mark.parametrize("dtype", ["float32", "uint16", "uint8"])
@pytest.mark.parametrize("value", [0, 7])
def test_a_chunk_that_is_gone_is_said_and_darkness_is_darkness(
    tmp_path: Path, dtype: str, value: int
) -> None:
    """A chunk that is not there reads as 0, and a chunk of 0 was not written."""
    path = write(tmp_path / "v.zarr", dtype, value)
    there = open_video(path)
    assert (there.frames(0, FRAMES) == value).all()
    assert (there.quality == 0).all()
    last = max((path / "0" / "c").iterdir(), key=lambda each: int(each.name))
    (last / "0" / "0").unlink()
    size = there.video.chunks[0]
    assert (open_video(path).frames(0, size) == value).all()
    with pytest.raises(DataError, match=rf"its file c/{last.name}/0/0 is missing.*try: a copy of the video"):
        open_video(path).frames(0, FRAMES)
    if dtype == "float32":  # also for programs that know nothing of this
        assert np.isnan(zarr.open_group(path, mode="r")["0"][-1]).all()


def test_every_reader_says_that_a_chunk_is_gone(tmp_path: Path) -> None:
    path = write(tmp_path / "v.zarr", "float32", 3)
    (path / "0" / "c" / "1" / "0" / "0").unlink()
    archive = Archive(tmp_path)
    # The page shows what is there, and names the others.
    size = open_video(path).video.chunks[0]
    assert archive.video("v.zarr").missing == [(size, 2 * size)]
    with pytest.raises(DataError, match="c/1/0/0 is missing"):
        archive.frames("v.zarr", size, size)
    ((data, _, _),) = read_video(path)
    with pytest.raises(DataError, match="c/1/0/0 is missing"):
        data[1]
    for *words, name in (("render", "--out", "v.png"), ("export", "v.npy"), ("export", "v.h5")):
        words.insert(1, str(path))
        error = CliRunner().invoke(app, [*words, str(tmp_path / name)]).exception
        assert isinstance(error, AcquireError), words
        assert (error.exit_code, "c/1/0/0 is missing" in str(error)) == (6, True), error
    assert [each.name for each in tmp_path.iterdir()] == ["v.zarr"]


@pytest.mark.parametrize("column", ["time", "quality"])
def test_a_column_that_is_gone_is_damage_and_not_zeros(tmp_path: Path, column: str) -> None:
    """All frames were of 1970, or perfectly explained."""
    path = write(tmp_path / "v.zarr", "uint8", 3)
    (path / column / "c" / "0").unlink()
    with pytest.raises(DataError, match="its file c/0 is missing"):
        open_video(path)
    assert "c/0 is missing" in (Archive(tmp_path).videos()[0].error or "")


def test_tiles_that_were_not_reached_are_no_damage(tmp_path: Path) -> None:
    path, side = tmp_path / "m.zarr", 16
    with MosaicWriter(path, (2, 2), side, VideoGrid((1e-6, 1.0, 1.0)), TIMES) as writer:
        for tile in ((0, 0), (1, 1)):
            ones = np.ones((FRAMES, side, side), np.float32)
            writer.put(0, tile, ones, ones[:, 0, 0], ones[:, :1, :1])
        writer.finish({"trusted": [0, 0]})
    frames = open_video(path).frames(0, FRAMES)
    assert np.isnan(frames[:, :side, side:]).all()
    assert (frames[:, :side, :side] == 1).all()
    (path / "0" / "c" / "0" / "0" / "0").unlink()
    with pytest.raises(DataError, match="c/0/0/0 is missing"):
        open_video(path).frames(0, FRAMES)


def test_an_earlier_video_is_read_as_before(tmp_path: Path) -> None:
    """Its chunks of 0 were not written, and are no damage."""
    path = write(tmp_path / "v.zarr", "uint8", 0)
    root = path / "zarr.json"
    root.write_text(root.read_text().replace("every_chunk_is_written", "of_another_program"))
    (path / "0" / "c" / "0" / "0" / "0").unlink()
    assert (open_video(path).frames(0, FRAMES) == 0).all()
