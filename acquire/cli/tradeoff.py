"""``acquire tradeoff``: what accuracy costs in time, and what `--budget` learns from it."""

from __future__ import annotations

import itertools
import os
import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.output import JsonFlag, print_json, print_table, say
from acquire.cli.places import new_directory
from acquire.cli.progress import stage_progress, told

if TYPE_CHECKING:
    from acquire.evaluate.tradeoff import Run
    from acquire.reconstruct.learned import Learned
    from acquire.simulate import Study
    from acquire.store import Recording

LINES, FIRST_LINE = 263, 200


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Simulation")(tradeoff)


def tradeoff(
    source: Annotated[str, typer.Argument(metavar="SCENE|RECORDING", help="A scene file, or NAME.zarr.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="New directory.")] = Path("acquire-tradeoff"),
    voxels: Annotated[list[str] | None, typer.Option(metavar="NMxTM", help="Repeatable; else 3x1.")] = None,
    solver: Annotated[list[str] | None, typer.Option(help="Repeatable; else every solver.")] = None,
    preset: Annotated[list[str] | None, typer.Option(help="Repeatable; else fast and balanced.")] = None,
    dtype: Annotated[list[str] | None, typer.Option(help="Repeatable; else float32 and float64.")] = None,
    first_line: Annotated[int | None, typer.Option(help="Of the segment.")] = None,
    lines: Annotated[int, typer.Option(help="How many lines, L_R.")] = LINES,
    budget: Annotated[float | None, typer.Option(metavar="SECONDS", help="No run longer than this.")] = None,
    learn: Annotated[bool, typer.Option(help="Keep it for --budget of acquire reconstruct.")] = True,
    json: JsonFlag = False,
) -> None:
    """Draw accuracy against wall time for every solver, preset, dtype and kind of voxels, step by step.

    Example: [bold]acquire tradeoff scene-leds --voxels 3x1 --voxels 3x4[/]
    """
    from acquire.arrays import DTYPES, open_arrays
    from acquire.cli.reconstruct_request import parse_voxels
    from acquire.cores import idle_cores, limit_blas
    from acquire.evaluate.tradeoff import Judge, measure, table
    from acquire.evaluate.tradeoff_page import write_page
    from acquire.recon import ITERATIONS
    from acquire.recon.request import preset_iterations
    from acquire.reconstruct.learned import remember

    kinds = [parse_voxels(text) for text in voxels or ["3x1"]]
    presets = tuple(preset or ("fast", "balanced"))
    solvers = solver or list(ITERATIONS)
    for each in solvers:
        for kind in presets:
            preset_iterations(each, kind)
    dtypes = [open_arrays("cpu", each).dtype for each in dtype or DTYPES]
    with new_directory(out):
        recording, study = _opened(source, out, (first_line or FIRST_LINE) + lines)
        segment = recording.cut(_first(recording, first_line, lines), lines)
        judge, runs = Judge.of(recording, segment), []
        for shape, each, exact in itertools.product(kinds, solvers, dtypes):
            with stage_progress(f"{each} {shape} {exact}") as advance, limit_blas(idle_cores()):
                runs.append(measure(judge, each, shape, presets, budget, advance, dtype=exact))  # type: ignore[arg-type]
        command = f"acquire {shlex.join(sys.argv[1:])}"
        page = write_page(runs, study, out, Path(source).stem, command, datetime.now(UTC))
    kept = remember(_lessons(runs)) if learn else None
    if json:
        print_json({"page": str(page), "learned": kept and str(kept), "rows": table(runs)})
        return
    _print(runs)
    say()
    say(f"page     {page}")
    if kept is not None:
        say(f"learned  {kept}")


def _first(recording: Recording, first_line: int | None, lines: int) -> int:
    if first_line is not None:
        return first_line
    return recording.first_line + max(0, min(FIRST_LINE, recording.lines - lines))


def _opened(source: str, out: Path, lines: int) -> tuple[Recording, Study | None]:
    """The recording, made where a scene is given; what the scene's effects are worth."""
    from acquire.config import load_rig, load_scene
    from acquire.simulate import bench_of, simulate, study
    from acquire.store import open_recording

    if "://" in source or os.path.isdir(source):  # noqa: PTH112  # Path's raises for an impossible name
        recording = open_recording(source)
        return recording, None
    scene = load_scene(source)
    rig = load_rig(scene.rig)
    with told() as tell:
        tell(f"recording {source}")
        simulate(rig, scene, out / "recording.zarr", lines)
        if not scene.effects:
            return open_recording(out / "recording.zarr"), None
        tell("leaving out one effect after the other")
        return open_recording(out / "recording.zarr"), study(bench_of(rig, scene), rig.code.build())


def _lessons(runs: list[Run]) -> list[Learned]:
    from acquire.reconstruct.learned import Learned

    return [
        Learned(
            run.solver,
            preset,
            run.voxels.spatial_merge,
            run.voxels.temporal_merge,
            run.voxel_count,
            point.seconds,
            point.psnr_db,
        )
        for run in runs
        for point in run.points
        for preset in point.presets
        if point.psnr_db is not None and run.dtype == "float32"  # what --budget chooses among
    ]


def _print(runs: list[Run]) -> None:
    def text(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    rows = [
        (
            str(run.voxels),
            run.solver,
            run.dtype,
            ", ".join(point.presets),
            str(point.iterations),
            text(point.seconds, 2),
            text(point.psnr_db, 2),
            text(point.ssim, 3),
            text(point.amplitude_error, 3),
            text(point.frequency_error_hz, 2),
        )
        for run in runs
        for point in run.points
    ]
    titles = (
        "voxels",
        "solver",
        "dtype",
        "preset",
        "iterations",
        "seconds",
        "PSNR",
        "SSIM",
        "amplitude",
        "Hz off",
    )
    print_table(titles, rows)
