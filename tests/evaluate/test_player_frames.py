"""Frames for a page's player: small and bounded, and the given ones."""

from __future__ import annotations

from base64 import b64decode
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from acquire.evaluate.player import beside, clip_of


def opened(uri: str) -> np.ndarray:
    content = b64decode(uri.removeprefix("data:image/webp;base64,"))
    with Image.open(BytesIO(content)) as picture:
        return np.asarray(picture.convert("L"), int)


def noise(frames: int) -> list[Image.Image]:
    """Frames that compress worst."""
    rng = np.random.default_rng(2)
    return [
        beside([rng.uniform(0, 1, (64, 64)) * 0.5 + number / frames / 2], 1.0) for number in range(frames)
    ]


@pytest.mark.parametrize("bound", [20_000, 60_000])
def test_frames_are_thinned_evenly_until_they_fit(bound: int) -> None:
    pictures = noise(40)
    clip = clip_of(pictures, bound)
    frames, step = clip.frames, clip.step
    assert step > 1
    assert len(frames) == -(-40 // step)
    assert sum(len(b64decode(each.partition(",")[2])) for each in frames) <= bound
    means = [opened(each).mean() for each in frames]
    assert np.diff(means) == pytest.approx(step * 255 / 80, abs=1.5)


def test_frames_that_fit_are_all_shown() -> None:
    clip = clip_of(noise(5))
    assert (len(clip.frames), clip.step) == (5, 1)


def test_it_begins_with_the_frame_that_shows_most() -> None:
    dark, plain, telling = np.zeros((16, 16)), np.full((16, 16), 0.9), np.eye(16)
    assert clip_of([beside([each], 1.0) for each in (dark, plain, telling, dark)]).start == 2


def test_frames_of_different_sizes_are_scaled_to_one_height() -> None:
    small, large = np.full((8, 8), 0.5), np.eye(24)
    picture = np.asarray(beside([small, large], 1.0).convert("L"), int)
    assert picture.shape == (24, 24 + 1 + 24)
    assert set(np.unique(picture[:, :24])) == {128}
    assert np.array_equal(picture[:, 25:], 255 * np.eye(24, dtype=int))
    assert beside([small, large], 1.0, 48).size == (48 + 2 + 48, 48)
