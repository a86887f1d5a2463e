"""``acquire render``: videos for people, from reconstructed ones."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath
from typing import Annotated

import typer

from acquire.cli.output import JsonFlag, print_json, quantity, say
from acquire.cli.progress import stage_progress
from acquire.errors import UsageError

SHEET_FRAMES = 12
MOVIE_FRAMES = 300


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Recordings")(render)


def render(
    video: Annotated[
        list[str],
        typer.Argument(metavar="VIDEO...", help="Videos, by path or URL; several are shown side by side."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE", help="New file: .mp4, .gif, .webp, .png (a sheet of frames), .html (a page)."
        ),
    ],
    frames: Annotated[
        int | None,
        typer.Option(help=f"Largest number of frames; absent: {MOVIE_FRAMES}, on a sheet {SHEET_FRAMES}."),
    ] = None,
    fps: Annotated[float, typer.Option(help="Frames that are shown per second.")] = 25.0,
    height: Annotated[int | None, typer.Option(metavar="PIXELS", help="Height of a panel.")] = None,
    peak: Annotated[
        float | None, typer.Option(help="Value that is shown white; absent: nearly the brightest.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Make a movie, an animation, a sheet of stills or a page of reconstructed videos.

    A page has a player that pauses and steps, what of the lines each frame leaves unexplained, and an account
    of every sub-segment.

    Example: [bold]acquire render fish-1x820.zarr fish-3x4.zarr --out fish.mp4[/]
    """
    from acquire.evaluate.rendering import Look, Panel, check_suffix
    from acquire.evaluate.rendering import render as draw
    from acquire.store import open_video
    from acquire.store.files import check_new_path

    sheet = out.suffix.lower() == ".png"
    count = frames if frames is not None else SHEET_FRAMES if sheet else MOVIE_FRAMES
    look = Look(height or (192 if sheet else 384), peak, fps)
    _check(count, look.panel_px, fps, peak)
    check_suffix(out)
    check_new_path(out)
    panels = [Panel(PurePosixPath(place).stem, open_video(place)) for place in video]
    part = out.with_name(f".{os.getpid()}.{out.name}")
    try:
        with stage_progress(f"rendering {out.name}") as advance:
            shown = draw(panels, part, look, count, advance)
        check_new_path(out)
        part.rename(out)
    finally:
        part.unlink(missing_ok=True)
    size = out.stat().st_size
    if json:
        print_json({"path": str(out), "frames": shown, "bytes": size})
    else:
        say(f"{out}: {shown} frames, {quantity(size, 'B')}")


def _check(count: int, height: int, fps: float, peak: float | None) -> None:
    for name, value, low, high in (
        ("--frames", count, 1, 100_000),
        ("--height", height, 16, 4096),
        ("--fps", fps, 0.1, 240),
        ("--peak", 1.0 if peak is None else peak, 1e-30, 1e30),
    ):
        if not low <= value <= high:
            raise UsageError(f"{name} {value} is out of range", possible=f"{low} to {high}")
