"""The animation of a result: which frames it shows, how large it is, and what its pixels are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from acquire.errors import UsageError
from acquire.evaluate.animation import BAR_PX, GAP_PX, PANEL_PX, draw_frame, panel, save_animation
from acquire.evaluate.report import DemoResult


@pytest.fixture(scope="module")
def short(result: DemoResult) -> DemoResult:
    """Twenty frames are enough to count."""
    few = slice(0, 20)
    solvers = tuple(
        replace(s, video=s.video[few], psnr_per_frame=s.psnr_per_frame[few]) for s in result.solvers
    )
    regions = tuple(replace(region, theory=region.theory[few]) for region in result.regions)
    return replace(
        result,
        truth=result.truth[few],
        frame_time_ns=result.frame_time_ns[few],
        solvers=solvers,
        regions=regions,
    )


def test_every_kth_frame_is_shown_at_its_place(short: DemoResult, tmp_path) -> None:
    path = tmp_path / "a.webp"
    assert save_animation(short, path, max_frames=7) == 3
    with Image.open(path) as animation:
        assert animation.n_frames == 7
        assert animation.size == (3 * PANEL_PX + 2 * GAP_PX, PANEL_PX + 2 * BAR_PX)
        assert animation.info["loop"] == 0
        animation.seek(5)
        shown = np.asarray(animation.convert("L"), float)
    expected = [np.asarray(draw_frame(short, frame).convert("L"), float) for frame in range(20)]
    distances = [np.abs(shown - picture).mean() for picture in expected]
    assert int(np.argmin(distances)) == 15


def test_a_file_too_large_is_thinned_out(short: DemoResult, tmp_path) -> None:
    path = tmp_path / "a.webp"
    save_animation(short, path)
    limit = path.stat().st_size // 2
    assert save_animation(short, path, max_bytes=limit) >= 2
    assert path.stat().st_size <= limit


def test_an_impossible_limit_is_refused_and_leaves_no_file(short: DemoResult, tmp_path) -> None:
    path = tmp_path / "a.webp"
    with pytest.raises(UsageError, match="20 frames does not fit into 100 bytes"):
        save_animation(short, path, max_bytes=100)
    assert not path.exists()


def test_black_is_0_white_is_the_peak_and_the_rest_is_clipped() -> None:
    frame = np.array([[0.0, 1.0], [2.0, 9.0]])
    pixels = np.asarray(panel(frame, 2.0))
    assert pixels.shape == (PANEL_PX, PANEL_PX)
    assert [pixels[5, 5], pixels[5, -5], pixels[-5, 5], pixels[-5, -5]] == [0, 128, 255, 255]
    assert np.asarray(panel(-frame, 2.0)).max() == 0


@pytest.mark.parametrize("shape", [(64, 64), (54, 54), (24, 40)])
def test_every_frame_size_fills_its_panel(shape) -> None:
    assert panel(np.ones(shape), 1.0).size == (PANEL_PX, PANEL_PX)


def test_panels_are_side_by_side_in_order(short: DemoResult) -> None:
    picture = np.asarray(draw_frame(short, 4).convert("L"))
    for i, video in enumerate([short.truth, *(solver.video for solver in short.solvers)]):
        left = i * (PANEL_PX + GAP_PX)
        inside = picture[BAR_PX : BAR_PX + PANEL_PX, left : left + PANEL_PX]
        np.testing.assert_array_equal(inside, np.asarray(panel(video[4], short.peak)))
