"""The truth and the reconstructions side by side as an animated WebP: lossy, small, plays in browsers."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageSequence

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.evaluate.result import DemoResult

PANEL_PX = 256
GAP_PX = 8
BAR_PX = 26
MAX_FRAMES = 150
MAX_BYTES = 3_000_000
FRAME_DURATION_MS = 80
"""Slow, because fast flicker can cause harm: with every 4th of the 10 µs frames, 5 kHz becomes 2.5 Hz."""


def save_animation(
    result: DemoResult, path: Path, *, max_frames: int = MAX_FRAMES, max_bytes: int = MAX_BYTES
) -> int:
    """Write every k-th frame to ``path`` (WebP) and return k, the smallest that keeps to both limits.

    Raises UsageError when not even two frames fit into ``max_bytes``.
    """
    frames = len(result.frame_ms)
    step = max(1, -(-frames // max_frames))
    while step < frames:
        write_webp(path, [draw_frame(result, frame) for frame in range(0, frames, step)])
        if path.stat().st_size <= max_bytes:
            return step
        # how large a file becomes is known only once it is written
        step *= 2
    # The last attempt is there, too large, and must not be taken for the result.
    path.unlink(missing_ok=True)
    raise UsageError(
        f"an animation of {frames} frames does not fit into {max_bytes} bytes",
        possible="more bytes per frame",
    )


def write_webp(path: Path, pictures: list[Image.Image], duration_ms: int = FRAME_DURATION_MS) -> None:
    """Write an endless loop of the pictures, each shown for ``duration_ms``."""
    first, *rest = pictures
    first.save(
        path,
        save_all=True,
        append_images=rest,
        duration=duration_ms,
        loop=0,
        quality=75,
        method=2,
        minimize_size=False,
    )


def stills(path: Path) -> Iterator[bytes]:
    """Yield the frames of an animation as separate WebP pictures, for a player that can stop at any."""
    with Image.open(path) as pictures:
        for picture in ImageSequence.Iterator(pictures):
            yield webp(picture.convert("RGB"), 75)


def webp(picture: Image.Image, quality: int) -> bytes:
    """Encode one picture as lossy WebP."""
    file = BytesIO()
    picture.save(file, "WEBP", quality=quality, method=2)
    return file.getvalue()


def draw_frame(result: DemoResult, frame: int) -> Image.Image:
    """Draw one picture: a bar of labels, panels of the truth and of each solver, a bar with the time."""
    panels = [("truth", result.truth), *((solver.label, solver.video) for solver in result.solvers)]
    width = len(panels) * (PANEL_PX + GAP_PX) - GAP_PX
    picture = Image.new("RGB", (width, PANEL_PX + 2 * BAR_PX), "#12181f")
    draw = ImageDraw.Draw(picture)
    # Pillow's own font: which others there are depends on the host.
    font = ImageFont.load_default(15)
    for i, (label, video) in enumerate(panels):
        left = i * (PANEL_PX + GAP_PX)
        picture.paste(panel(video[frame], result.peak), (left, BAR_PX))
        draw.text((left + 6, BAR_PX / 2), label, fill="white", font=font, anchor="lm")
    time = f"{result.frame_ms[frame]:.2f} ms   frame {frame} of {len(result.frame_ms)}"
    draw.text((6, PANEL_PX + 1.5 * BAR_PX), time, fill="#cbd2d9", font=font, anchor="lm")
    return picture


def panel(frame: NDArray[Any], peak: float) -> Image.Image:
    """Draw a frame (row, column) as an 8-bit grey picture of PANEL_PX: 0 is black, ``peak`` white."""
    grey = np.clip(np.rint(frame * (255 / peak)), 0, 255).astype(np.uint8)
    # an integer factor keeps the pixels sharp; any other would make them unequal
    whole = PANEL_PX % frame.shape[0] == 0 and frame.shape[0] == frame.shape[1]
    resample = Image.Resampling.NEAREST if whole else Image.Resampling.BICUBIC
    return Image.fromarray(grey).resize((PANEL_PX, PANEL_PX), resample)
