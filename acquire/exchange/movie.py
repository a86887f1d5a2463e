"""MP4 (H.264): a video for viewing, in 8-bit grey, with its facts in the comment of the file."""

from __future__ import annotations

import json
from fractions import Fraction
from itertools import count
from math import gcd
from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import UsageError
from acquire.exchange.libraries import library

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.exchange.content import Content

PEAK_QUANTILE = 0.999
SAMPLED = 65_536
"""Number of voxels of a block that are sampled to find the white level."""
MOST_SIDE = 8192
USUAL_SIDE = 256
"""Usual side of a movie: a smaller video is enlarged to about this size by an integer factor."""


def check_movie(content: Content) -> None:
    """Raise UsageError for content that is not a video, or for a video that H.264 cannot hold."""
    if content.kind != "video":
        raise UsageError(
            f"{content.title} cannot become a movie: it is a recording, whose lines are not pictures",
            possible=".tif, .ome.tif, .h5, .npy, .npz",
            hint="acquire reconstruct, and export its video",
        )
    if max(content.image.shape[1:]) > MOST_SIDE:
        raise UsageError(
            f"an MP4 file cannot have {content.image.shape[1:]} pixels",
            possible=f"up to {MOST_SIDE} pixels along each side",
        )
    library("av", "video", "an MP4 file")


def write_movie(
    path: Path, content: Content, advance: Callable[[int], object], fps: float, peak: float | None
) -> None:
    """Write a movie of ``fps`` frames per second, grey from 0 to ``peak`` (None: close to the brightest)."""
    av = library("av", "video", "an MP4 file")
    white = peak or _white(content)
    # by an integer, so that pixels stay equal squares
    times = max(1, USUAL_SIDE // max(content.image.shape[1:]))
    height, width = (side * times for side in content.image.shape[1:])
    known = {"left_out": [each.name for each in content.beside]} if content.beside else {}
    facts = content.facts | known | {"white": white, "shown_fps": fps, "enlarged": times}
    with av.open(str(path), "w", format="mp4", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata["title"] = content.title
        container.metadata["comment"] = json.dumps(facts)
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        # Browsers play H.264 with halved colours only; libx264 calls a quality of 18 visually lossless.
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "18"}
        stream.width, stream.height = width + width % 2, height + height % 2
        for _, block in content.image.blocks():
            for frame in block:
                # NaN, as in tiles that were not reached, has no grey value
                light = np.nan_to_num(frame.astype(np.float32))
                grey = np.rint(np.clip(light * (255 / white), 0, 255)).astype(np.uint8)
                large = grey.repeat(times, axis=0).repeat(times, axis=1)
                # The codec needs even sides, so an odd one repeats its last row or column.
                even = np.pad(large, [(0, side % 2) for side in large.shape], mode="edge")
                picture = av.VideoFrame.from_ndarray(even, format="gray")
                container.mux(stream.encode(picture))
            advance(block.nbytes)
        # Without a frame: what the codec still holds back.
        container.mux(stream.encode())


def _white(content: Content) -> float:
    """Return a value close to the brightest voxel, from a sample of every block."""
    found, columns = [0.0], content.image.shape[-1]
    for _, block in content.image.blocks():
        # A step that has a factor in common with the width would never see some of the columns.
        steps = count(max(1, block.size // SAMPLED))
        some = block.reshape(-1)[:: next(step for step in steps if gcd(step, columns) == 1)]
        known = some[np.isfinite(some)]
        if known.size:
            found.append(float(np.quantile(known, PEAK_QUANTILE)))
    return max(found) or 1.0
