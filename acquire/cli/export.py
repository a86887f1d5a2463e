"""``acquire export``: write videos and recordings in the file formats of other programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.moments import after_ns
from acquire.cli.output import JsonFlag, print_json, print_warning, quantity, say
from acquire.cli.progress import stage_progress
from acquire.cli.stretch import FirstLineOption, FromOption, LinesOption, ToOption, lines_between
from acquire.errors import UsageError
from acquire.text import counted

if TYPE_CHECKING:
    from acquire.store import VideoFile

ROUNDING = 1e-6
"""Tolerance in frame intervals, since times are whole nanoseconds."""


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Recordings")(export)


def export(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Video or recording: NAME.zarr, or its URL.")
    ],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="New file. Its suffix sets the format: .tif, .ome.tif, .h5, .nxs, .npy, .npz or .mp4.",
        ),
    ],
    first_frame: Annotated[
        int | None, typer.Option(help="For a video: number of the first frame. Default: the first one.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="For a video: number of frames. Default: all frames to the end.")
    ] = None,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    average: Annotated[
        int,
        typer.Option(
            min=1,
            metavar="LINES",
            help="For a recording: average this number of lines into one, as an overview.",
        ),
    ] = 1,
    begin: FromOption = None,
    end: ToOption = None,
    all_frames: Annotated[
        bool,
        typer.Option(
            "--all-frames",
            help="Also write frames that are not trusted (sampled only in part), and mark them.",
        ),
    ] = False,
    fps: Annotated[float, typer.Option(help="Frames per second of a movie.")] = 25.0,
    peak: Annotated[
        float | None,
        typer.Option(help="Value shown as white in a movie. Default: close to the brightest value."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Write a video, or the lines of a recording, as a TIFF, HDF5 (NeXus), NumPy or MP4 file.

    Only the trusted frames of a video are written, unless --all-frames is given. Every format except .npy
    records where the data comes from. The estimated error of a video's regions is included, except in .tif,
    .npy and .mp4 files, which cannot hold it.

    Example: [bold]acquire export video.zarr video.tif --from 2ms --to 5ms[/]
    """
    from acquire.exchange import export as write
    from acquire.exchange import left_out, recording_content, video_content
    from acquire.exchange.export import format_for
    from acquire.store import format_of, open_recording, open_video
    from acquire.store.delivery import check_new_file

    if not 0.1 <= fps <= 240:
        raise UsageError(f"--fps {fps} is out of range", possible="0.1 to 240")
    if peak is not None and not (math.isfinite(peak) and peak > 0):
        raise UsageError(f"--peak {peak} is out of range", possible="a finite number above 0")
    # Refused before the source is opened, which may be far away.
    format_for(out)
    check_new_file(out)
    # None is not a format of ours: `open_recording` then reports what is there instead.
    if (format_of(source) or "").startswith("acquire-video/"):
        # 1, the default, averages nothing and is no mistake with a video.
        averaged = average if average > 1 else None
        _refuse_numbers("video", "--first-frame and --frames", first_line, lines, averaged)
        video = open_video(source)
        chosen = _frames_between(video, first_frame, frames, begin, end)
        content = video_content(video, source, chosen, whole=all_frames)
    else:
        opened = open_recording(source)
        _refuse_numbers("recording", "--first-line and --lines", first_frame, frames)
        if all_frames:
            raise UsageError("--all-frames: a recording has no frames", possible="--all-frames with a video")
        first, count = lines_between(opened, first_line, lines, begin, end)
        # Retention may have dropped the first lines of an endless recording.
        start = (opened.first_available_line if first is None else first) - opened.first_line
        stop = opened.lines if count is None else start + count
        content = recording_content(opened, range(start, stop, average))
    with stage_progress(f"writing {out.name}, MB") as advance:
        size = write(content, out, lambda done, total: advance(done / 1e6, total / 1e6), fps=fps, peak=peak)
    missing = left_out(content, out)
    if json:
        facts = {"path": str(out), "bytes": size, "shape": content.image.shape, **content.facts}
        print_json(facts | ({"left_out": missing} if missing else {}))
    else:
        shape = " × ".join(map(str, content.image.shape))
        say(f"{out}: {shape} ({', '.join(content.image.dims)}), {quantity(size, 'B')}")
    if missing:
        print_warning(
            f"{out.name} does not hold the estimated error of the regions; .ome.tif, .h5 and .npz files do"
        )
    if content.untrusted:
        of = counted(content.image.shape[0], "frame")
        are = "is" if content.untrusted == 1 else "are"
        print_warning(
            f"{content.untrusted} of {of} {are} not trusted: sampled in part only",
        )


def _refuse_numbers(kind: str, possible: str, *numbers: int | None) -> None:
    if any(number is not None for number in numbers):
        other = "frames" if kind == "recording" else "lines"
        raise UsageError(f"a {kind} has no {other}", possible=f"{possible}, or --from and --to")


def _frames_between(
    video: VideoFile, first: int | None, count: int | None, begin: str | None, end: str | None
) -> range:
    """Return the frames that the options select, by numbers or by times (those that begin in the time given).

    Raises UsageError if both are given, or if the video has no such frames.
    """
    total = len(video.time_ns)
    if count is not None and count < 1:
        raise UsageError(f"a count of {count} cannot be written", possible="1 or more")
    if begin is None and end is None:
        start = 0 if first is None else first
        return range(start, total if count is None else start + count)
    if first is not None or count is not None:
        raise UsageError(
            "numbers and times of frames exclude each other",
            possible="--first-frame and --frames, or --from and --to",
        )
    # A video without frames is refused below, whatever the times.
    first_ns, interval_ns = int(video.time_ns[0]) if total else 0, video.interval_ns
    low, high = (after_ns(text, lambda: first_ns) for text in (begin, end))
    # Rounded up: a frame that began before the range is not one of it.
    start = 0 if low is None else math.ceil(low / interval_ns - ROUNDING)
    stop = total if high is None else math.ceil(high / interval_ns - ROUNDING)
    if not 0 <= start < stop <= total:
        raise UsageError(
            f"there are no frames from {begin or 'the first'} to {end or 'the last'}",
            possible=f"0ms to {total * interval_ns / 1e6:.6g}ms after the first",
        )
    return range(start, stop)
