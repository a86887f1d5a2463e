"""Renderings of videos: MP4, GIF, WebP, a PNG sheet of frames, or a page, with several videos side by side.

Every panel shows the frame of its own video at the common time, so that videos with different voxels of the
same lines (selective reconstruction) run in step. Grey is linear from 0 to ``peak``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from acquire.errors import UsageError
from acquire.evaluate.animation import write_webp

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.store import VideoFile

BAR_PX, GAP_PX = 26, 8
PAPER, WORDS, SOFT = "#12181f", "#ffffff", "#cbd2d9"
PEAK_QUANTILE = 0.999
SHEET_COLUMNS = 6
SUFFIXES = (".mp4", ".gif", ".webp", ".png", ".html")


@dataclass(frozen=True, slots=True)
class Appearance:
    """Appearance of a rendering: panel height, value of white (None: from the video), frame rate, labels."""

    panel_px: int = 384
    peak: float | None = None
    fps: float = 25.0
    label: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One video in a rendering."""

    name: str
    file: VideoFile

    def at(self, time_ns: int) -> NDArray[Any]:
        """Return the frame shown at a time."""
        index = self.index(time_ns)
        frame: NDArray[Any] = self.file.frames(index, index + 1)[0]
        return frame

    def index(self, time_ns: int) -> int:
        """Return the number of the frame shown at a time."""
        index = int(np.searchsorted(self.file.time_ns, time_ns, "right")) - 1
        return min(max(index, 0), self.file.video.shape[0] - 1)


def check_suffix(path: Path) -> None:
    """Raise UsageError if the suffix of a file name is none of `SUFFIXES`."""
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(
            f"{path} cannot be rendered: "
            + (f"{path.suffix} is not a known format" if path.suffix else "its name has no suffix"),
            possible=".mp4 (a movie), .gif or .webp (an animation), .png (a sheet of stills), "
            ".html (a page with a player)",
            # pathlib has no other suffix for a path without a name, such as "." and "/"
            hint=f"--out {path.with_suffix('.mp4') if path.name else 'NAME.mp4'}",
        )


def common_times(panels: Sequence[Panel], count: int) -> NDArray[np.int64]:
    """Return up to ``count`` equally spaced instants at which the finest panel has a new frame and all have
    one.

    Raises UsageError if the videos have no time in common.
    """
    finest = min(panels, key=lambda panel: panel.file.interval_ns).file.time_ns
    begin = max(int(panel.file.time_ns[0]) for panel in panels)
    # the last frame is shown for as long as the others
    end = min(panel.file.time_ns[-1] + panel.file.interval_ns for panel in panels)
    times = finest[(finest >= begin) & (finest < end)]
    if not len(times):
        raise UsageError(
            "the videos have no time in common, so they cannot be shown side by side",
            hint="one page or movie for each of them",
        )
    # Whole steps, so that the instants stay equally far apart.
    step = -(-len(times) // max(1, count))
    chosen: NDArray[np.int64] = times[::step]
    return chosen


def render(
    panels: Sequence[Panel],
    path: Path,
    look: Appearance,
    count: int,
    progress: Callable[[int, int], object] | None = None,
) -> int:
    """Write up to ``count`` frames in the format of ``path``'s suffix; return their number.

    Raises UsageError as `check_suffix`, and for MP4 if its extra is not installed.
    """
    check_suffix(path)
    times = common_times(panels, count)
    peaks = [look.peak or _peak(panel) for panel in panels]
    if path.suffix.lower() == ".html":
        from acquire.evaluate.video_page import write_page  # imports matplotlib, which is slow

        return write_page(panels, peaks, times, path=path, look=look, progress=progress)
    stamps = [f"{(time_ns - int(times[0])) / 1e6:.3f} ms" if look.label else "" for time_ns in times.tolist()]

    def pictures() -> Iterator[Image.Image]:
        for number, time_ns in enumerate(times.tolist()):
            yield _picture(panels, [panel.at(time_ns) for panel in panels], peaks, look, stamps[number])
            if progress is not None:
                progress(number + 1, len(times))

    match path.suffix.lower():
        case ".png":
            _sheet(list(pictures())).save(path)
        case ".mp4":
            _write_mp4(path, pictures(), look.fps)
        # Pillow writes an animation only once it has all of its pictures.
        case ".webp":
            write_webp(path, list(pictures()), round(1000 / look.fps))
        case ".gif":
            first, *rest = pictures()
            duration = round(1000 / look.fps)
            first.save(path, save_all=True, append_images=rest, duration=duration, loop=0, optimize=False)
    return len(times)


def _picture(
    panels: Sequence[Panel],
    frames: Sequence[NDArray[Any]],
    peaks: Sequence[float],
    look: Appearance,
    stamp: str,
) -> Image.Image:
    greys = [grey(frame, peak, look.panel_px) for frame, peak in zip(frames, peaks, strict=True)]
    bar = BAR_PX if look.label else 0
    top = bar if len(panels) > 1 else 0
    width = sum(each.width for each in greys) + GAP_PX * (len(greys) - 1)
    picture = Image.new("RGB", (width + width % 2, top + look.panel_px + bar), PAPER)
    # Pillow's own font: which others there are depends on the host.
    draw, font, left = ImageDraw.Draw(picture), ImageFont.load_default(15), 0
    for panel, each in zip(panels, greys, strict=True):
        picture.paste(each, (left, top))
        if top:
            draw.text((left + 6, top / 2), panel.name, fill=WORDS, font=font, anchor="lm")
        left += each.width + GAP_PX
    if bar:
        draw.text((6, picture.height - bar / 2), stamp, fill=SOFT, font=font, anchor="lm")
    return picture


def grey(frame: NDArray[Any], peak: float, height_px: int) -> Image.Image:
    """Draw a frame (row, column) in 8 bits, from 0 (black) to ``peak`` (white), with square, sharp pixels."""
    rows, columns = frame.shape
    # NaN, as in tiles that were not reached, has no grey value
    values = np.clip(np.rint(np.nan_to_num(frame) * (255 / peak)), 0, 255).astype(np.uint8)
    enlarge = height_px >= 3 * rows
    # A reduced picture must not leave out pixels, as the nearest would.
    resample = Image.Resampling.NEAREST if enlarge else Image.Resampling.LANCZOS
    width = round(height_px * columns / rows)  # made even, as the codec of MP4 needs it
    return Image.fromarray(values).resize((width + width % 2, height_px), resample)


def _peak(panel: Panel) -> float:
    """Return the value of white for a video: close to its brightest voxel, from a few frames."""
    frames = panel.file.video.shape[0]
    some = np.unique(np.linspace(0, frames - 1, 12).astype(int))
    values = np.stack([panel.file.frames(index, index + 1) for index in some.tolist()])
    known = values[np.isfinite(values)]
    # a dark video has no peak to divide by
    return float(np.quantile(known, PEAK_QUANTILE) if known.size else 0) or 1.0


def _sheet(pictures: list[Image.Image]) -> Image.Image:
    columns = min(SHEET_COLUMNS, len(pictures))
    rows = -(-len(pictures) // columns)
    width, height = pictures[0].size
    sheet = Image.new("RGB", (columns * (width + GAP_PX) - GAP_PX, rows * (height + GAP_PX) - GAP_PX), PAPER)
    for number, picture in enumerate(pictures):
        row, column = divmod(number, columns)
        sheet.paste(picture, (column * (width + GAP_PX), row * (height + GAP_PX)))
    return sheet


def _write_mp4(path: Path, pictures: Iterator[Image.Image], fps: float) -> None:
    try:
        import av
    except ModuleNotFoundError as error:
        raise UsageError(
            f"{path.name} cannot be rendered without PyAV",
            possible=", ".join(suffix for suffix in SUFFIXES if suffix != ".mp4"),
            hint="pip install 'tdi-acquire[video]'",
        ) from error
    from fractions import Fraction

    first = next(pictures)
    with av.open(str(path), "w") as container:
        # the codec's clock needs a fraction with small terms
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        # As in the movies of `acquire export`.
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "18"}
        # the codec halves the resolution of colours, so it needs even sizes
        stream.width, stream.height = (side - side % 2 for side in first.size)
        for picture in chain([first], pictures):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(picture))))
        # the encoder still holds frames back
        container.mux(stream.encode())
