"""``acquire tradeoff``: measure accuracy against time, and let `reconstruct --budget` learn from it."""

from __future__ import annotations

import itertools
import os
import shlex
import sys
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.durations import seconds
from acquire.cli.output import JsonFlag, print_json, print_table, print_warning, say
from acquire.cli.places import new_directory
from acquire.cli.progress import activity_progress, stage_progress
from acquire.cli.tiles import TileOption, tile_of
from acquire.errors import EXIT_INTERRUPTED, UsageError

if TYPE_CHECKING:
    from acquire.evaluate.cases import Case
    from acquire.evaluate.host import HostWatch
    from acquire.evaluate.tradeoff import TradeoffRun
    from acquire.recon.segments import Voxels
    from acquire.reconstruct.learned import Learned
    from acquire.simulate import Study
    from acquire.store import Recording

LINES, FIRST_LINE = 263, 200
ONE_RUN = "One run of each kind."
APART = 67
"""Distance between two repeats, in lines."""
LONGEST_S = 60.0
MOST_LINES = 100_000


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Simulation")(tradeoff)


def tradeoff(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENE|RECORDING",
            help="Scene files, recordings (NAME.zarr), or procedural scenes such as splash, bullet and "
            "flame.",
        ),
    ],
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="New directory for the page and all its data.")
    ] = Path("acquire-tradeoff"),
    full_well: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ELECTRONS",
            help="Electrons in the brightest sample of procedural scenes, or 'clean' (no noise). Repeatable. "
            "Default: 1e4.",
        ),
    ] = None,
    voxels: Annotated[
        list[str] | None,
        typer.Option(metavar="NMxTM", help="Voxel size to try, N_m x T_m. Repeatable. Default: 3x1."),
    ] = None,
    solver: Annotated[
        list[str] | None,
        typer.Option(metavar="SOLVER", help="Solver to try. Repeatable. Default: all solvers."),
    ] = None,
    preset: Annotated[
        list[str] | None,
        typer.Option(metavar="PRESET", help="Preset to try. Repeatable. Default: fast and balanced."),
    ] = None,
    dtype: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TYPE",
            help="Floating-point type to try, float32 or float64. Repeatable. Default: float32.",
        ),
    ] = None,
    repeats: Annotated[
        int, typer.Option(min=1, max=20, help="Number of runs of each kind, whose spread the curves show.")
    ] = 3,
    first_line: Annotated[
        int | None,
        typer.Option(
            help="Number of the first line to use. Default: chosen near the start of the recording."
        ),
    ] = None,
    lines: Annotated[
        int, typer.Option(min=1, max=MOST_LINES, help="L_R, number of lines to reconstruct.")
    ] = LINES,
    budget: Annotated[
        float,
        typer.Option(
            parser=seconds,
            metavar="TIME",
            help=f"Time limit for each run. Runs that reach it are marked. Default: {LONGEST_S:g}s.",
            show_default=False,
        ),
    ] = LONGEST_S,
    tile: TileOption = None,
    learn: Annotated[
        bool,
        typer.Option(help="Save the results, so that `acquire reconstruct --budget` picks the best preset."),
    ] = True,
    json: JsonFlag = False,
) -> None:
    """Plot accuracy against wall and processor time for solvers, presets and voxel sizes, on one page.

    Behind a fibre one tile is used: the one given, or the one whose lines change most.

    Example: [bold]acquire tradeoff scene-leds splash bullet --full-well clean --full-well 1e4[/]
    """
    from acquire.arrays import open_arrays
    from acquire.cli.reconstruct_request import parse_voxels
    from acquire.evaluate.host import HostWatch
    from acquire.evaluate.tradeoff import table
    from acquire.evaluate.tradeoff_page import write_page
    from acquire.plugins import SOLVERS
    from acquire.recon.solver import preset_iterations
    from acquire.reconstruct.learned import remember

    kinds = tuple(parse_voxels(text) for text in voxels or ["3x1"])
    # Of all solvers only those that can be imported: somebody's broken plug-in must not end a study.
    combinations = list(
        itertools.product(solver or SOLVERS.working(), preset or ("fast", "balanced"), dtype or ("float32",))
    )
    for solver_name, preset_name, dtype_name in combinations:  # raises for unknown names
        preset_iterations(solver_name, preset_name)
        open_arrays("cpu", dtype_name)
    if not budget > 0:
        raise UsageError(f"a budget of {budget:g} s is out of range", possible="more than 0")
    with new_directory(out):
        cases, effects = _cases(sources, out, full_well or [], (first_line, lines, repeats), tile)
        host = HostWatch()
        total = len(cases) * repeats * len(kinds) * len(combinations)
        runs, truths = _measure(cases, repeats, kinds, combinations=combinations, longest_s=budget, host=host)
        interrupted = f"Interrupted after {len(runs)} of {total} runs." if len(runs) < total else None
        differences = dict.fromkeys(case.repeats for case in cases)
        heading = {
            "title": ", ".join(Path(source).stem for source in sources),
            "command": f"acquire {shlex.join(sys.argv[1:])}",
            "notes": [
                *([] if interrupted is None else [interrupted]),
                *([f"{repeats} repeats: {each}." for each in differences] if repeats > 1 else [ONE_RUN]),
            ],
            "host": host.busyness().facts(),
        }
        page = write_page(runs, truths, effects, directory=out, heading=heading, when=datetime.now(UTC))
    kept = None
    # An interrupted study has fewer repeats, of some cases only: it must not decide for all later commands.
    if learn and interrupted is None:
        try:
            kept = remember(_lessons(runs))
        except OSError as error:  # the page is there, and may have taken hours
            why = f"{error.filename or 'their file'}: {error.strerror or error}"
            print_warning(
                f"the presets' results are not kept for --budget ({why}); "
                "try: an XDG_CACHE_HOME that can be written"
            )
    if json:
        facts = {"page": str(page), "learned": kept and str(kept), "interrupted": interrupted}
        print_json({**facts, "rows": table(runs)})
        if interrupted is not None:
            raise typer.Exit(EXIT_INTERRUPTED)
        return
    _print(runs)
    say()
    say(f"page     {page}")
    if kept is not None:
        say(f"learned  {kept}")
    if interrupted is not None:
        print_warning(f"{interrupted[:-1]}: the page has only these, and no preset is learned from them")
        raise typer.Exit(EXIT_INTERRUPTED)


def _measure(
    cases: list[Case],
    repeats: int,
    kinds: tuple[Voxels, ...],
    *,
    combinations: list[tuple[str, str, str]],
    longest_s: float,
    host: HostWatch,
) -> tuple[list[TradeoffRun], dict[tuple[str, Voxels], Any]]:
    """Measure every combination of solver, preset and dtype; return the runs and the true frames to show.

    Ctrl-C ends it with the runs made so far, which may have taken hours, if there are any.
    """
    from acquire.evaluate.tradeoff import measure

    runs: list[TradeoffRun] = []
    truths: dict[tuple[str, Voxels], Any] = {}
    try:
        for case, repeat in itertools.product(cases, range(repeats)):
            with activity_progress(f"preparing {case.name}"):
                judge = case.judge(repeat)
            for voxels, (solver, preset, dtype) in itertools.product(kinds, combinations):
                # The page says how busy the host was, since that decides the times.
                host.look()
                what = f"{case.name}: {solver} {preset} {voxels}, {repeat + 1} of {repeats}"
                with stage_progress(what) as advance:
                    run = measure(
                        judge,
                        solver,
                        voxels,
                        preset=preset,  # type: ignore[arg-type]  # checked in `tradeoff`
                        longest_s=longest_s,
                        progress=advance,
                        dtype=dtype,  # type: ignore[arg-type]  # checked in `tradeoff`
                    )
                runs.append(replace(run, case=case.name, repeat=repeat))
                # The page shows frames of one repeat; a view of them would keep the whole truth in memory.
                if repeat == 0:
                    true = judge.truth(voxels)
                    truths[case.name, voxels] = None if true is None else true[judge.picked(voxels)].copy()
    except KeyboardInterrupt:
        if not runs:
            raise
    host.look()
    return runs, truths


def _cases(
    sources: list[str],
    out: Path,
    full_well: list[str],
    extent: tuple[int | None, int, int],
    tile: str | None,
) -> tuple[list[Case], Study | None]:
    """Return the cases to measure, and the study of the effects of the first scene that has any.

    ``extent`` is the first line, the number of lines and the number of repeats.
    """
    from acquire.evaluate.cases import full_wells, procedural, recording_case
    from acquire.reconstruct.liveliest import representative_tile
    from acquire.sim.procedural import SCENES

    (first_line, lines, repeats), cases, effects = extent, [], None
    wells = full_wells(full_well or ["1e4"])
    stems = Counter(Path(source).stem for source in set(sources))
    for source in dict.fromkeys(sources):
        if source in SCENES:
            cases += [procedural(source, each, lines) for each in wells]
            continue
        # As many lines as the last repeat will need.
        most = (first_line or FIRST_LINE) + lines + (repeats - 1) * APART
        recording, found = _opened(source, out, most)
        effects = effects or found
        first = first_line
        if first is None:  # not the very beginning, if there is room
            first = recording.first_line + max(0, min(FIRST_LINE, recording.lines - lines))
        given = tile_of(recording, tile)
        used = representative_tile(recording, () if given is None else (given,), (first, lines))
        recording.cut(first, lines, used)  # raises for missing lines, before anything is measured
        # Runs of one name are repeats: recordings that share theirs are told apart by their places.
        name = source if stems[Path(source).stem] > 1 else Path(source).stem
        cases.append(recording_case(name, recording, first_line=first, lines=lines, apart=APART, tile=used))
    return cases, effects


def _opened(source: str, out: Path, lines: int) -> tuple[Recording, Study | None]:
    """Open a recording, or record a scene; in the latter case also study the scene's effects."""
    from acquire.config import load_rig, load_scene
    from acquire.simulate import bench_of, simulate, study
    from acquire.store import open_recording

    # A recording is a directory or a URL, a scene a file or a name.
    if "://" in source or os.path.isdir(source):  # noqa: PTH112  # Path.is_dir raises for an impossible name
        recording = open_recording(source)
        return recording, None
    scene, stem = load_scene(source), Path(source).stem
    # Scenes in different directories may have one name.
    places = (out / f"{stem}{'' if number == 1 else f'-{number}'}.zarr" for number in itertools.count(1))
    place = next(each for each in places if not each.exists())
    rig = load_rig(scene.rig)
    with activity_progress(f"recording {source}") as report:
        simulate(rig, scene, place, lines)
        if not scene.effects:
            return open_recording(place), None
        report("leaving out the effects in turn")
        return open_recording(place), study(bench_of(rig, scene), rig.code.build())


def _lessons(runs: list[TradeoffRun]) -> list[Learned]:
    """Return the median results of each kind of run. Runs cut by the time limit do not judge their preset."""
    from acquire.evaluate.tradeoff_figures import in_series
    from acquire.reconstruct.learned import Learned

    lessons = []
    for case, voxels in dict.fromkeys((run.case, run.voxels) for run in runs):
        own = [run for run in runs if (run.case, run.voxels) == (case, voxels)]
        for (solver, preset, dtype), repeats in in_series(own).items():
            reached = [run.end.psnr_db for run in repeats if run.end.psnr_db is not None]
            # `reconstruct` computes in float32 unless told otherwise.
            if dtype != "float32" or not reached or any(run.cut for run in repeats):
                continue
            seconds = median(run.end.seconds for run in repeats)
            merges, count = (voxels.spatial_merge, voxels.temporal_merge), repeats[0].voxel_count
            lessons.append(Learned(solver, preset, *merges, count, case, seconds, median(reached)))
    return lessons


def _print(runs: list[TradeoffRun]) -> None:
    """Print where each run ended, and sentences about the accuracy gained over time."""
    from acquire.evaluate.knees import sentences
    from acquire.evaluate.tradeoff_figures import in_series

    def text(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    rows = [
        (
            run.case,
            str(run.voxels),
            run.solver,
            run.preset,
            f"{run.end.iterations}{' (cut)' if run.cut else ''}",
            text(run.end.seconds, 1),
            text(run.end.processor_s, 1),
            text(run.end.psnr_db, 1),
            text(run.end.ssim, 2),
            text(run.end.amplitude_error, 3),
            text(run.end.frequency_error_hz, 1),
        )
        for run in runs
    ]
    titles = ("case", "voxels", "solver", "preset", "iterations", "wall (s)", "processor (s)")
    print_table((*titles, "PSNR (dB)", "SSIM", "amplitude error", "frequency error (Hz)"), rows)
    for case, voxels in dict.fromkeys((run.case, run.voxels) for run in runs):
        own = [run for run in runs if (run.case, run.voxels) == (case, voxels)]
        for repeats in in_series(own).values():
            for sentence in sentences(repeats):
                say(f"{case}, {voxels}: {sentence}")
