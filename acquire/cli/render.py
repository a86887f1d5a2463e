"""``acquire render``: turn reconstructed videos into movies, animations, stills or a page."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Annotated

import typer

from acquire.cli.output import JsonFlag, print_json, quantity, say
from acquire.cli.places import given_path
from acquire.cli.progress import stage_progress
from acquire.errors import UsageError
from acquire.text import counted

SHEET_FRAMES, MOVIE_FRAMES = 12, 300
SHEET_HEIGHT, MOVIE_HEIGHT = 192, 384


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Recordings")(render)


def render(
    video: Annotated[
        list[str],
        typer.Argument(metavar="VIDEO", help="Videos, by path or URL. Several are shown side by side."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="New file. Its suffix sets the format: .mp4, .gif, .webp, .png (a sheet of frames) or .html "
            "(a page).",
        ),
    ],
    frames: Annotated[
        int | None,
        typer.Option(
            help=f"Maximum number of frames. Default: {MOVIE_FRAMES}, or {SHEET_FRAMES} on a sheet."
        ),
    ] = None,
    fps: Annotated[float, typer.Option(help="Frames shown per second.")] = 25.0,
    height: Annotated[
        int | None,
        typer.Option(
            metavar="PIXELS",
            help=f"Height of each video in pixels. Default: {MOVIE_HEIGHT}, or {SHEET_HEIGHT} on a sheet.",
        ),
    ] = None,
    peak: Annotated[
        float | None, typer.Option(help="Value shown as white. Default: close to the brightest value.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Turn reconstructed videos into a movie, an animation, a sheet of stills or a page.

    A page has a player with single steps, the residual of every frame over time, and the parameters and
    quality of every sub-segment.

    Example: [bold]acquire render fish-1x820.zarr fish-3x4.zarr --out fish.mp4[/]
    """
    from acquire.evaluate.rendering import Appearance, Panel, check_suffix
    from acquire.evaluate.rendering import render as draw
    from acquire.store import open_video
    from acquire.store.delivery import check_new_file, whole_file
    from acquire.store.refusals import refused

    sheet = out.suffix.lower() == ".png"
    count = frames if frames is not None else SHEET_FRAMES if sheet else MOVIE_FRAMES
    usual_px = SHEET_HEIGHT if sheet else MOVIE_HEIGHT
    look = Appearance(usual_px if height is None else height, peak, fps)
    for name, value, low, high in (
        ("--frames", count, 1, 100_000),
        ("--height", look.panel_px, 16, 4096),
        ("--fps", fps, 0.1, 240),
        ("--peak", 1.0 if peak is None else peak, 1e-30, 1e30),
    ):
        if not low <= value <= high:
            raise UsageError(f"{name} {value} is out of range", possible=f"{low} to {high}")
    check_suffix(out)
    check_new_file(out)
    # A URL has slashes on every system.
    panels = [Panel(PurePosixPath(place).stem, open_video(given_path(place))) for place in video]
    with (
        stage_progress(f"rendering {out.name}") as advance,
        whole_file(out, keep_suffix=True) as part,
        refused(out, "written"),
    ):
        shown = draw(panels, part, look, count, advance)
    size = out.stat().st_size
    if json:
        print_json({"path": str(out), "frames": shown, "bytes": size})
    else:
        say(f"{out}: {counted(shown, 'frame')}, {quantity(size, 'B')}")
