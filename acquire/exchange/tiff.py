"""TIFF: an ImageJ hyperstack, or an OME-TIFF of any size (``.ome.tif``).

The image is contiguous behind the header, so that it can be written block by block as it is read.
Accompanying arrays become a second image of an OME-TIFF. A hyperstack has none, because Bio-Formats and
others would show a page behind its frames as one more frame.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.exchange.libraries import library
from acquire.text import visible

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.exchange.content import Content

# Headers and facts have to be within the offsets' reach, too.
MOST_BYTES = 2**32 - 2**26
"""Largest image in a file with 32-bit offsets."""
AXES = {"video": "TYX", "lines": "CYX"}
"""Axis letters of ImageJ and OME: the arms of a recording are channels, its lines are rows."""


def check_tiff(content: Content, *, ome: bool) -> None:
    """Raise UsageError for an image that such a file cannot hold."""
    library("tifffile", "export", "a TIFF file")
    if not ome and content.image.bytes > MOST_BYTES:
        raise UsageError(
            f"a TIFF file for ImageJ cannot hold {content.image.bytes} bytes of pixels",
            possible=f"up to {MOST_BYTES} bytes",
            hint="NAME.ome.tif or NAME.h5, which can; or a part, with --from and --to",
        )


def write_tiff(path: Path, content: Content, advance: Callable[[int], object], *, ome: bool) -> None:
    """Write a TIFF file. Raises OSError from the disk."""
    tifffile = library("tifffile", "export", "a TIFF file")
    kind: dict[str, Any] = {"ome": True, "bigtiff": True} if ome else {"imagej": True}
    beside, (*_, y, x) = content.beside if ome else (), content.axes
    with tifffile.TiffWriter(path, byteorder="<", **kind) as writer:
        writer.write(
            None,
            shape=content.image.shape,
            dtype=content.image.dtype,
            # Stated, or tifffile would guess: it takes a last axis of 3 or 4 for colours.
            photometric="minisblack",
            metadata=_ome(content) if ome else _imagej(content),
            resolution=(1 / (x.step or 1.0), 1 / (y.step or 1.0)),  # pixels per unit
            # TIFF knows inches and centimetres only; the unit is in ImageJ's or OME's own description.
            resolutionunit="NONE",
        )
        for array in beside:
            about = {"axes": "TYX", "Name": array.name, "Description": json.dumps(array.attributes)}
            empty = {"shape": array.shape, "dtype": array.dtype, "photometric": "minisblack"}
            writer.write(None, **empty, metadata=about)
    # The writer has left space for the pixels. Its position is known only from the finished headers.
    with tifffile.TiffFile(path) as reader:
        places = [each.dataoffset for each in reader.series]
    with path.open("r+b") as file:
        for place, array in zip(places, (content.image, *beside), strict=True):
            file.seek(place)
            for _, block in array.blocks():
                file.write(np.ascontiguousarray(block).data)
                advance(block.nbytes)


def _imagej(content: Content) -> dict[str, Any]:
    facts: dict[str, Any] = {"axes": AXES[content.kind], "Info": json.dumps(content.facts, indent=1)}
    if content.kind == "lines":
        return {**facts, "Labels": [f"arm {arm}" for arm in content.facts["arms"]]}
    time, unit = content.axes[0], content.axes[-1].unit
    # ImageJ's description is ASCII, and it reads other characters in this form.
    plain = "".join(each if each.isascii() else f"\\u{ord(each):04X}" for each in visible(unit))
    return {**facts, "finterval": time.step, "fps": 1 / (time.step or 1.0), "unit": plain}


def _ome(content: Content) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "axes": AXES[content.kind],
        "Name": content.title,
        "Description": json.dumps(content.facts),
    }
    if content.kind == "lines":
        return {**facts, "Channel": {"Name": [f"arm {arm}" for arm in content.facts["arms"]]}}
    time, y, x = content.axes
    for axis in (y, x):
        letter, unit = axis.name.upper(), "µm" if axis.unit == "um" else axis.unit
        facts |= {f"PhysicalSize{letter}": axis.step, f"PhysicalSize{letter}Unit": unit}
    began = datetime.fromtimestamp(content.facts["first_frame_utc_ns"] // 10**9, UTC).replace(tzinfo=None)
    facts["AcquisitionDate"] = began.isoformat()  # OME expects UTC without a time zone
    return {**facts, "TimeIncrement": time.step, "TimeIncrementUnit": "s"}
