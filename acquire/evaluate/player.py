"""Videos for the player of a page: frame by frame, as small as they are; the page enlarges them."""

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

MAX_BYTES = 400_000
QUALITY = 88


def beside(panels: Sequence[NDArray[Any]], peak: float, height_px: int | None = None) -> Image.Image:
    """Frames (row, column) side by side; 0 is black, ``peak`` white. As high as the highest if not told."""
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
    """Every ``step``-th picture as a URI; ``start`` is the one of most contrast, for who sees only one."""

    frames: list[str]
    step: int
    start: int


def clip_of(pictures: Sequence[Image.Image], max_bytes: int = MAX_BYTES) -> Clip:
    """The pictures as WebP, every second left out until they keep to ``max_bytes``."""
    frames, step = [webp(picture, QUALITY) for picture in pictures], 1
    while len(frames) > 2 and sum(map(len, frames)) > max_bytes:
        frames, step = frames[::2], 2 * step
    contrast = [np.asarray(picture.convert("L")).std() for picture in pictures[::step]]
    return Clip([webp_uri(each) for each in frames], step, int(np.argmax(contrast)))
