"""Videos for the player of a page: separate frames in their original size, which the page enlarges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from acquire.evaluate.animation import webp
from acquire.evaluate.page import webp_uri
from acquire.evaluate.rendering import PAPER, grey

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

# In the page, as base64, they take a third more.
MAX_BYTES = 400_000
QUALITY = 88


def beside(panels: Sequence[NDArray[Any]], peak: float, height_px: int | None = None) -> Image.Image:
    """Draw frames (row, column) side by side, from 0 (black) to ``peak`` (white).

    The height is ``height_px``, or that of the highest frame.
    """
    height = height_px or max(len(panel) for panel in panels)
    greys = [grey(panel, peak, height) for panel in panels]
    gap = max(1, height // 24)
    picture = Image.new("RGB", (sum(each.width + gap for each in greys) - gap, height), PAPER)
    left = 0
    for each in greys:
        picture.paste(each, (left, 0))
        left += each.width + gap
    return picture


@dataclass(frozen=True, slots=True)
class Clip:
    """Every ``step``-th picture as a URI; ``start`` has the most contrast, and is shown first."""

    frames: list[str]
    step: int
    start: int


def clip_of(pictures: Sequence[Image.Image], max_bytes: int = MAX_BYTES) -> Clip:
    """Encode the pictures as WebP; every second one is dropped until they fit into ``max_bytes``."""
    frames, step = [webp(picture, QUALITY) for picture in pictures], 1
    # Two frames are the least that can be played.
    while len(frames) > 2 and sum(map(len, frames)) > max_bytes:
        # by halves, so that the frames that are left stay equally far apart
        frames, step = frames[::2], 2 * step
    contrast = [np.asarray(picture.convert("L")).std() for picture in pictures[::step]]
    return Clip([webp_uri(each) for each in frames], step, int(np.argmax(contrast)))
