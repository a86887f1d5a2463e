"""MP4 (H.264): a video for people, in 8 bits of grey; its facts are in the comment of the file."""

from __future__ import annotations

import json
from fractions import Fraction
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
"""Voxels of a block that are looked at to find out what is white."""
MOST_SIDE = 8192
USUAL_SIDE = 256
"""Of a movie: a smaller video is enlarged by a whole factor, pixel by pixel, to about that."""


def check_movie(content: Content) -> None:
    """UsageError for what is no video, or a video that H.264 cannot hold."""
    if content.kind != "video":
        raise UsageError(
            f"{content.title} cannot become a movie: it is a recording, whose lines are no pictures",
            possible=".tif, .ome.tif, .h5, .npy, .npz",
            hint="acquire reconstruct, and export its video",
        )
    if max(content.image.shape[1:]) > MOST_SIDE:
        raise UsageError(
            f"an MP4 file cannot have {content.image.shape[1:]} pixels", possible=f"up to {MOST_SIDE}"
        )
    library("av", "video", "an MP4 file")


def write_movie(
    path: Path, content: Content, advance: Callable[[int], object], fps: float, peak: float | None
) -> None:
    """``fps`` frames a second, grey linear from 0 to ``peak`` (None: nearly the brightest)."""
    av = library("av", "video", "an MP4 file")
    white = peak or _white(content)
    times = max(1, USUAL_SIDE // max(content.image.shape[1:]))
    height, width = (side * times for side in content.image.shape[1:])
    known = {"left_out": [each.name for each in content.beside]} if content.beside else {}
    facts = content.facts | known | {"white": white, "shown_fps": fps, "enlarged": times}
    with av.open(str(path), "w", format="mp4", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata["title"] = content.title
        container.metadata["comment"] = json.dumps(facts)
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "18"}
        stream.width, stream.height = width + width % 2, height + height % 2
        for _, block in content.image.blocks():
            for frame in block:
                # The codec wants even sides: an odd one gets its last row or column twice.
                grey = np.rint(np.clip(frame.astype(np.float32) * (255 / white), 0, 255)).astype(np.uint8)
                large = grey.repeat(times, axis=0).repeat(times, axis=1)
                even = np.pad(large, [(0, side % 2) for side in large.shape], mode="edge")
                picture = av.VideoFrame.from_ndarray(even, format="gray")
                container.mux(stream.encode(picture))
            advance(block.nbytes)
        container.mux(stream.encode())


def _white(content: Content) -> float:
    """Nearly the brightest voxel, from some of every block."""
    found = [0.0]
    for _, block in content.image.blocks():
        some = block.reshape(-1)[:: max(1, block.size // SAMPLED)]
        found.append(float(np.quantile(some, PEAK_QUANTILE)))
    return max(found) or 1.0
