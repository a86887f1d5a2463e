"""``acquire export``: videos and recordings in the files of other programs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.moments import after_ns
from acquire.cli.output import JsonFlag, print_json, print_warning, quantity, say
from acquire.cli.progress import stage_progress
from acquire.cli.stretch import FirstLineOption, FromOption, LinesOption, ToOption, lines_between
from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.exchange import Content
    from acquire.store import Recording, VideoFile

ROUNDING = 1e-6
"""Of a period: times are whole nanoseconds."""


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Recordings")(export)


@dataclass(frozen=True, slots=True)
class _Part:
    """What of the source is asked for, as given: by numbers (first, count), or by times."""

    first: int | None
    count: int | None
    begin: str | None
    end: str | None

    def check(self) -> None:
        by_number = self.first is not None or self.count is not None
        if by_number and (self.begin is not None or self.end is not None):
            raise UsageError(
                "numbers and times exclude each other",
                possible="--first-line and --lines, --first-frame and --frames, or --from and --to",
            )
        if self.count is not None and self.count < 1:
            raise UsageError(f"a count of {self.count} cannot be written", possible="1 or more")


def export(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="A video or a recording: NAME.zarr, or its URL.")
    ],
    out: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="New file: .tif, .ome.tif, .h5, .nxs, .npy, .npz or .mp4."),
    ],
    first_frame: Annotated[
        int | None, typer.Option(help="Number of a video's first frame; absent: its first.")
    ] = None,
    frames: Annotated[int | None, typer.Option(help="Number of frames; absent: all that follow.")] = None,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    average: Annotated[
        int,
        typer.Option(
            min=1, metavar="LINES", help="Number of lines that are averaged into one, for an overview."
        ),
    ] = 1,
    begin: FromOption = None,
    end: ToOption = None,
    all_frames: Annotated[
        bool, typer.Option("--all-frames", help="Write frames that are sampled in part, too, marked as such.")
    ] = False,
    fps: Annotated[float, typer.Option(help="Frames that a movie shows per second.")] = 25.0,
    peak: Annotated[
        float | None, typer.Option(help="Value that is white in a movie; absent: nearly the brightest.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Write a video, or the lines of a recording, as TIFF, HDF5 (NeXus), NumPy file or MP4.

    Of a video the trusted frames alone are written, unless you ask for all of them. The file says where it
    comes from; .npy holds the numbers alone. The error that a video tells of its regions is taken along but
    for .tif, .npy and .mp4, which have no place for it.

    Example: [bold]acquire export video.zarr video.tif --from 2ms --to 5ms[/]
    """
    from acquire.exchange import export as write
    from acquire.exchange import left_out
    from acquire.exchange.export import format_for
    from acquire.store import format_of, open_recording, open_video
    from acquire.store.files import check_new_path

    _check_look(fps, peak)
    format_for(out)
    check_new_path(out)
    if (format_of(source) or "").startswith("acquire-video/"):
        averaged = average if average > 1 else None
        _refuse_numbers("video", "--first-frame and --frames", first_line, lines, averaged)
        part = _Part(first_frame, frames, begin, end)
        content = _of_video(open_video(source), source, part, whole=all_frames)
    else:
        opened = open_recording(source)
        _refuse_numbers("recording", "--first-line and --lines", first_frame, frames)
        content = _of_recording(opened, _Part(first_line, lines, begin, end), average)
    with stage_progress(f"writing {out.name}, MB") as advance:
        size = write(content, out, lambda done, total: advance(done / 1e6, total / 1e6), fps=fps, peak=peak)
    missing = left_out(content, out)
    if json:
        told = {"path": str(out), "bytes": size, "shape": content.image.shape, **content.facts}
        print_json(told | ({"left_out": missing} if missing else {}))
    else:
        shape = " × ".join(map(str, content.image.shape))
        say(f"{out}: {shape} ({', '.join(content.image.dims)}), {quantity(size, 'B')}")
    if missing:
        print_warning(
            f"{out.name} has no place for the estimated error of regions: .ome.tif, .h5 and .npz have"
        )
    if content.untrusted:
        print_warning(
            f"{content.untrusted} of {content.image.shape[0]} frames are not trusted: sampled in part"
        )


def _check_look(fps: float, peak: float | None) -> None:
    if not 0.1 <= fps <= 240:
        raise UsageError(f"--fps {fps} is out of range", possible="0.1 to 240")
    if peak is not None and not (math.isfinite(peak) and peak > 0):
        raise UsageError(f"--peak {peak} is out of range", possible="a finite number above 0")


def _refuse_numbers(kind: str, possible: str, *numbers: int | None) -> None:
    if any(number is not None for number in numbers):
        other = "frames" if kind == "recording" else "lines"
        raise UsageError(f"a {kind} has no {other}", possible=f"{possible}, or --from and --to")


def _of_video(video: VideoFile, name: str, part: _Part, *, whole: bool) -> Content:
    from acquire.exchange import video_content

    part.check()
    count = len(video.time_ns)
    first = 0 if part.first is None else part.first
    frames = range(first, count if part.count is None else first + part.count)
    if part.begin is not None or part.end is not None:
        interval_ns, start = video.interval_ns, int(video.time_ns[0]) if count else 0
        frames = _numbers(part, 0, count, period_ns=interval_ns, first_ns=start, what="frames")
    return video_content(video, name, frames, whole=whole)


def _of_recording(recording: Recording, part: _Part, average: int) -> Content:
    from acquire.exchange import recording_content

    first, count = lines_between(recording, part.first, part.count, part.begin, part.end)
    begin = 0 if first is None else first - recording.first_line
    end = recording.lines if count is None else begin + count
    return recording_content(recording, range(begin, end, average))


def _numbers(part: _Part, first: int, end: int, period_ns: float, first_ns: int, what: str) -> range:
    """Those that begin in the time asked for. UsageError where the time is not covered."""
    low, high = (after_ns(text, lambda: first_ns) for text in (part.begin, part.end))
    start = first if low is None else first + math.ceil(low / period_ns - ROUNDING)
    stop = end if high is None else first + math.ceil(high / period_ns - ROUNDING)
    if not first <= start < stop <= end:
        have = f"0ms to {(end - first) * period_ns / 1e6:.6g}ms after the first"
        raise UsageError(
            f"there are no {what} from {part.begin or 'the first'} to {part.end or 'the last'}", possible=have
        )
    return range(start, stop)
