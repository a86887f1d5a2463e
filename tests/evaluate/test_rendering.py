"""Movies, animations and sheets of real videos on disk; several run on one clock."""

from __future__ import annotations

import os

import av
import numpy as np
import pytest
from PIL import Image

from acquire.errors import DataError, UsageError
from acquire.evaluate.rendering import Appearance, Panel, common_times, render
from acquire.store import open_video, write_video

START = np.int64(1_700_000_000_000_000_000)


def panel(tmp_path, name, frames, interval_ns, side=12, begin=0):
    video = np.zeros((frames, side, side), np.float32)
    video[np.arange(frames), 0, np.arange(frames) % side] = 1
    video[:, side // 2 :, :] = 0.5
    return written(tmp_path, name, video, interval_ns, begin)


def written(tmp_path, name, video, interval_ns=1000, begin=0, **provenance):
    path = tmp_path / f"{name}.zarr"
    write_video(
        path,
        video,
        START + begin + np.arange(len(video)) * interval_ns,
        pixel_size=1.0,
        frame_interval_ns=interval_ns,
        provenance=provenance,
    )
    return Panel(name, open_video(path))


def test_a_sheet_shows_frames_and_times(tmp_path):
    render([panel(tmp_path, "a", 10, 1000)], tmp_path / "s.png", Appearance(panel_px=48), 4)
    with Image.open(tmp_path / "s.png") as sheet:
        values = np.asarray(sheet.convert("L"))
    assert values.shape[1] >= 4 * 48
    assert set(np.unique(values[30:44, 2:44])) == {128}  # the lower half of the first frame, 0.5 of white


def test_a_movie_has_the_frames_that_were_asked_for(tmp_path):
    shown = render([panel(tmp_path, "a", 50, 1000)], tmp_path / "m.mp4", Appearance(panel_px=96), 25)
    with av.open(tmp_path / "m.mp4") as movie:
        frames = [frame.to_ndarray(format="gray") for frame in movie.decode(video=0)]
    assert len(frames) == shown == 25
    assert abs(int(frames[3][80, 50]) - 128) < 12


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_animations(tmp_path, suffix):
    render([panel(tmp_path, "a", 6, 1000)], tmp_path / f"m{suffix}", Appearance(panel_px=48), 6)
    with Image.open(tmp_path / f"m{suffix}") as animation:
        assert animation.n_frames == 6


def test_panels_of_other_intervals_share_the_clock(tmp_path):
    fast, slow = panel(tmp_path, "fast", 40, 1000), panel(tmp_path, "slow", 5, 10_000, begin=-3000)
    times = common_times([fast, slow], 1000)
    assert len(times) == 40
    shown = [int(slow.at(int(time))[0].argmax()) for time in times]
    assert shown == [(i + 3) // 10 for i in range(40)]


@pytest.mark.parametrize("suffix", [".png", ".mp4", ".html"])
def test_tiles_that_were_not_reached_are_black_and_the_others_as_usual(tmp_path, suffix):
    """They are NaN, which made white NaN, and with it every frame black."""
    video = np.full((6, 12, 24), 0.5, np.float32)
    video[:, 0, 0] = 1
    video[:, :, 12:] = np.nan
    assert (
        render([written(tmp_path, "v", video, trusted=[0, 0])], tmp_path / f"r{suffix}", Appearance(48), 6)
        > 0
    )
    if suffix == ".png":
        with Image.open(tmp_path / "r.png") as sheet:
            values = np.asarray(sheet.convert("L"))
        assert set(np.unique(values[10:44, 2:44])) == {128}
        assert set(np.unique(values[10:44, 52:92])) == {0}


def test_a_video_of_which_nothing_was_reached_is_black(tmp_path):
    video = np.full((3, 12, 12), np.nan, np.float32)
    assert render([written(tmp_path, "v", video, trusted=[0, 0])], tmp_path / "r.png", Appearance(48), 3) == 3


def test_impossible_renderings_are_refused(tmp_path):
    one = panel(tmp_path, "a", 5, 1000)
    with pytest.raises(UsageError, match=r"\.mp4"):
        render([one], tmp_path / "m.avi", Appearance(), 5)
    with pytest.raises(UsageError, match="no time in common"):
        render([one, panel(tmp_path, "b", 5, 1000, begin=10**9)], tmp_path / "m.gif", Appearance(), 5)


def test_a_damaged_video_is_refused_and_leaves_no_file(tmp_path):
    found = panel(tmp_path, "a", 6, 1000)
    for file in (tmp_path / "a.zarr" / "0" / "c").rglob("*"):
        if file.is_file():
            os.truncate(file, file.stat().st_size // 2)
    with pytest.raises(DataError, match=r"frames 0 to 0 of .*a\.zarr.* cannot be read: .*; try: a copy"):
        render([found], tmp_path / "s.png", Appearance(panel_px=48), 4)
    assert not (tmp_path / "s.png").exists()
