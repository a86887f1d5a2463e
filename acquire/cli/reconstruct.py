"""``acquire reconstruct``: make videos from the lines of a recording."""

from __future__ import annotations

import re
import sys
import time
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.completion import plans
from acquire.cli.durations import seconds
from acquire.cli.interrupts import stop_on_interrupt
from acquire.cli.output import JsonFlag, note, print_json, print_warning
from acquire.cli.progress import stage_progress
from acquire.cli.recordings import PlaceArgument
from acquire.cli.stretch import FirstLineOption, FromOption, LinesOption, ToOption
from acquire.cli.tiles import TilesOption, tiles_of
from acquire.errors import EXIT_INTERRUPTED, UsageError

if TYPE_CHECKING:
    from acquire.calibrate.choose import Chosen
    from acquire.cli.reconstruct_request import Arguments, Prepared
    from acquire.reconstruct import Outcome
    from acquire.store import Recording


QUICKER = "--from and --to (a part), --preview (seconds), --preset fast, --budget SECONDS, or larger voxels"
SEARCHES = {None: None, "each": False, "shared": True}

PROCESSES_FROM = 5.0
"""A time limit shorter than this many times the start of a process is spent in the main process."""
LEAST_S = 1e-3


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Recordings")(reconstruct)


def reconstruct(
    recording: PlaceArgument,
    out: Annotated[
        str | None,
        typer.Option(
            metavar="VIDEO",
            help="New video: a directory NAME.zarr, or a URL. Required without --auto or --explain.",
        ),
    ] = None,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    spatial_merge: Annotated[
        int | None,
        typer.Option("--spatial-merge", "--nm", help="N_m, side of a voxel in fine pixels. Default: 3."),
    ] = None,
    temporal_merge: Annotated[
        int | None,
        typer.Option("--temporal-merge", "--tm", help="T_m, number of sub-steps per frame. Default: 1."),
    ] = None,
    voxels: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NMxTM",
            help="Voxel size N_m x T_m, such as 1x820, instead of --nm and --tm. Repeatable: one video for "
            "each size, from the same lines.",
        ),
    ] = None,
    plan: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            autocompletion=plans,
            help="Plan (TOML) that divides the range into sub-segments with voxel sizes of their own, or the "
            "name of a built-in plan.",
        ),
    ] = None,
    segment: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LENGTH:NMxTM",
            help="Add a sub-segment to the plan, with its length in lines or time: 712:3x4, 1.1ms:1x230, or "
            ":3x4 for the rest. Repeatable.",
        ),
    ] = None,
    auto: Annotated[
        bool,
        typer.Option(
            "--auto", help="Propose a plan based on the lines and explain it; with --out, also carry it out."
        ),
    ] = False,
    save_plan: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="With --auto, --plan or --segment: write the plan to this new file."
        ),
    ] = None,
    ends: Annotated[
        str | None,
        typer.Option(
            metavar="trusted|whole",
            help="Frames at the ends of the video: trusted (only those), or whole (also frames that are "
            "sampled only in part). Default: trusted, or what the plan says.",
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="PRESET",
            help="Effort: fast, balanced or best. Default: balanced, or with --budget the preset that "
            "`acquire tradeoff` found best.",
        ),
    ] = None,
    solver: Annotated[
        str,
        typer.Option(
            metavar="SOLVER",
            help="Solver: admm, twist (the paper's), twist-band, or another one listed by `acquire plugins`.",
        ),
    ] = "admm",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Set an option of the solver. Repeatable."),
    ] = None,
    denoiser: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Denoiser to use instead of total variation: haar, or another one listed by `acquire "
            "plugins`.",
        ),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            parser=seconds, metavar="TIME", help="Time limit for the whole command. Default: no limit."
        ),
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Number of iterations. Default: set by the preset.")
    ] = None,
    dtype: Annotated[
        str, typer.Option(metavar="TYPE", help="Floating-point type of the computation: float32 or float64.")
    ] = "float32",
    device: Annotated[
        str, typer.Option(metavar="cpu|gpu", help="Processor: cpu, or gpu (CUDA through CuPy).")
    ] = "cpu",
    calibration: Annotated[
        str | None,
        typer.Option(
            metavar="CAL", help="Calibration NAME.zarr, or 'none'. Default: the one in the recording."
        ),
    ] = None,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain",
            help="Show what each part of the calibration gains and costs; without --out or --auto, nothing "
            "else is done.",
        ),
    ] = False,
    try_orientations: Annotated[
        bool,
        typer.Option(
            "--try-orientations",
            help="Swap or mirror the arms if the lines clearly show that this is needed.",
        ),
    ] = False,
    tiles: TilesOption = None,
    search: Annotated[
        str | None,
        typer.Option(
            metavar="each|shared",
            help="Search for prior and weight: in each tile or sub-segment (each), or once for all (shared). "
            "Default: shared for tiles, each for sub-segments.",
        ),
    ] = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="Make a coarse video in a second or two.")
    ] = False,
    workers: Annotated[int | None, typer.Option(help="Number of processes. Default: one per core.")] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute on the Dask cluster with this scheduler: tcp://HOST:8786. Default: this machine.",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Reconstruct a range of a recording as a video (OME-Zarr), with any voxel size.

    Ctrl-C ends the work and keeps the best result so far.

    Example: [bold]acquire reconstruct run.zarr --out video.zarr --from 52ms --to 57.98ms --nm 3 --tm 1[/]
    """
    from acquire.arrays import open_arrays
    from acquire.calibrate.choose import choose
    from acquire.cli.reconstruct_request import Arguments, check_arguments
    from acquire.config import parse_settings
    from acquire.recon.denoisers import open_denoiser
    from acquire.recon.solver import open_solver
    from acquire.reconstruct import Options
    from acquire.store import open_recording

    # A budget is the time of the whole command: the imports above count, too.
    began = time.monotonic() - _age_s()
    # Everything that can be wrong is checked before the solver runs.
    _check_options(search, iterations, (workers, dask), anything_wanted=bool(out or auto or explain))
    solver_options = parse_settings(settings or ())
    # Built here to be checked, and once more by every process that solves.
    open_solver(solver, solver_options)
    if denoiser is not None:
        open_denoiser(denoiser)
    open_arrays(device if dask is None else "cpu", dtype)  # the devices of a cluster are not on this machine
    opened = open_recording(recording)
    chosen = choose(opened, calibration)
    arguments = Arguments(
        first_line=first_line,
        lines=lines,
        begin=begin,
        end=end,
        voxels=_voxels(voxels, spatial_merge, temporal_merge),
        plan=plan,
        segments=tuple(segment or ()),
        auto=auto,
        save_plan=save_plan,
        ends=ends,
        preview=preview,
        preset=preset,
        options=Options(
            preset="balanced",
            solver=solver,
            iterations=iterations,
            budget_s=budget,
            dtype=dtype,  # type: ignore[arg-type]  # checked by open_arrays
            device=device,
            calibration=None if chosen is None else chosen.calibration,
            solver_options=solver_options,
            denoiser=denoiser,
            shared=SEARCHES[search],
        ),
        tiles=tiles_of(opened, tiles),
        out=out,
        explain=explain,
        try_orientations=try_orientations,
        workers=workers,
        dask=dask,
    )
    check_arguments(arguments)
    _carry_out(opened, chosen, arguments, began, json=json)


def _carry_out(
    recording: Recording, chosen: Chosen | None, arguments: Arguments, began: float, *, json: bool
) -> None:
    """Explain, plan and make what the arguments ask for, and print it; ``began`` starts the time limit."""
    from acquire.cli.reconstruct_explain import explain_calibration
    from acquire.cli.reconstruct_report import print_outcomes, print_prepared
    from acquire.cli.reconstruct_request import prepare, suffixes

    out = arguments.out
    # A place that is taken is refused before minutes of computing.
    places = [] if out is None else _new_places(out, suffixes(arguments))
    for doubt in () if chosen is None else chosen.doubts:
        print_warning(doubt)
    explained = explain_calibration(recording, chosen, arguments, json=json) if arguments.explain else {}
    if arguments.explain and not (out or arguments.auto):
        if json:
            print_json(explained)
        return
    if arguments.try_orientations:
        arguments = _with_orientation(recording, arguments)
    prepared = prepare(recording, arguments)
    if not json:
        print_prepared(prepared)
    if out is None:
        if json and prepared.plan is not None:
            print_json({**explained, "plan": prepared.plan.model_dump(mode="json", exclude_none=True)})
        return
    outcomes = _make(recording, prepared, places, arguments, began)
    more = {"explained": explained} if explained else {}
    print_outcomes(outcomes, json=json, preview=arguments.preview, more=more)
    if outcomes[-1].interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)


def _check_options(
    search: str | None,
    iterations: int | None,
    where: tuple[int | None, str | None],
    *,
    anything_wanted: bool,
) -> None:
    if not anything_wanted:
        raise UsageError(
            "reconstruct needs --out, the video to write",
            possible="--out NAME.zarr; --auto alone shows a plan, --explain the effect of a calibration",
        )
    if search not in SEARCHES:
        raise UsageError(f"there is no --search {search}", possible="each, shared")
    # The solver refuses it, too, but only in processes whose start takes seconds.
    if iterations is not None and iterations < 1:
        raise UsageError(f"{iterations} iterations are not possible", possible="1 or more")
    if None not in where:
        raise UsageError(
            "--workers has no effect with --dask, whose cluster has workers of its own",
            possible="one of them",
        )


def _voxels(
    sizes: list[str] | None, spatial_merge: int | None, temporal_merge: int | None
) -> tuple[str, ...]:
    """Return the voxel sizes that were asked for, in either way; none if there was no such option."""
    if spatial_merge is None and temporal_merge is None:
        return tuple(sizes or ())
    for option, merge in (("--nm", spatial_merge), ("--tm", temporal_merge)):
        if merge is not None and merge < 1:
            raise UsageError(f"{option} {merge} is out of range", possible="1 or more")
    if sizes:
        raise UsageError(
            "--voxels and --nm or --tm exclude each other", possible="--voxels NMxTM, or --nm and --tm"
        )
    return (
        f"{3 if spatial_merge is None else spatial_merge}x{1 if temporal_merge is None else temporal_merge}",
    )


def _new_places(out: str, names: list[str]) -> list[str]:
    """Return the place of each video: NAME.zarr, or one of several, NAME-1x820.zarr.

    Raises UsageError if one exists, or if the name is that of a file in another format.
    """
    from acquire.store.delivery import check_new_place

    stem = out.rstrip("/")
    _check_suffix(stem)
    places = [re.sub(r"(\.[^./]*)?$", rf"-{name}\1", stem, count=1) if name else out for name in names]
    for place in places:
        check_new_place(place)
    return places


def _check_suffix(out: str) -> None:
    """Raise UsageError for a name under which other programs would expect a file: NAME.mp4, NAME.tif."""
    suffix = PurePosixPath(out).suffix.lower()
    if suffix in ("", ".zarr"):
        return
    from acquire.evaluate.rendering import SUFFIXES as RENDERED
    from acquire.exchange.export import SUFFIXES as EXPORTED

    if suffix in {*RENDERED, *EXPORTED}:
        raise UsageError(
            f"a video of reconstruct is an OME-Zarr directory, and not {suffix}",
            possible=f"--out {PurePosixPath(out).with_suffix('.zarr')}",
            hint="acquire export or acquire render, which make such files of it",
        )


def _make(
    recording: Recording,
    prepared: Prepared,
    places: list[str],
    arguments: Arguments,
    began: float,
) -> list[Outcome]:
    """Make the videos one after the other, until the first that is interrupted."""
    from acquire.reconstruct import Monitor, combine, open_pool

    workers, budget_s = arguments.workers, prepared.options.budget_s
    hurried = budget_s is not None and budget_s < PROCESSES_FROM * _age_s()
    # One process fills a GPU; starting several would take at least as long as starting this one did.
    if workers is None and (arguments.preview or hurried or prepared.options.device != "cpu"):
        workers = 1
    outcomes: list[Outcome] = []
    for place, request in zip(places, prepared.requests.values(), strict=True):
        options = prepared.options
        if options.budget_s is not None:
            # An equal share of what is left. Every limit counts from the command's start, so what has passed
            # is added.
            elapsed_s = time.monotonic() - began
            share_s = (options.budget_s - elapsed_s) / (len(places) - len(outcomes))
            # More than 0, as a budget has to be, even if the videos before have taken all of it.
            options = replace(options, budget_s=max(elapsed_s + share_s, LEAST_S))
        tasks = len(request.stretches) * max(1, len(request.tiles))
        name = f"reconstructing {PurePosixPath(place).name}"
        with (
            stop_on_interrupt("finishing the current sub-segments with their results so far") as stopped,
            # No advice beside a budget: 20 s were once announced as 25 minutes.
            stage_progress(name, QUICKER if options.budget_s is None else "") as advance,
        ):
            monitor = Monitor(tasks, advance, stopped.is_set)
            with open_pool(tasks, workers, arguments.dask, monitor) as pool:
                outcome = combine(
                    recording, request, place, options=options, pool=pool, monitor=monitor, began=began
                )
        outcomes.append(outcome)
        # Ctrl-C is meant for the whole command.
        if outcome.interrupted:
            break
    return outcomes


def _with_orientation(recording: Recording, arguments: Arguments) -> Arguments:
    """Adopt the orientation of the arms that the lines show, if the evidence is clear; report the result."""
    from acquire.cli.reconstruct_request import requested_lines
    from acquire.recon.diagnosis import TURNED
    from acquire.recon.hypotheses import AS_BUILT
    from acquire.recon.search import Standing
    from acquire.reconstruct.diagnose import diagnose_recording, diagnosed_range
    from acquire.reconstruct.reorient import reoriented

    first, count = diagnosed_range(recording, *requested_lines(recording, arguments))
    found = diagnose_recording(recording, first, count, arguments.options.calibration)
    turn = AS_BUILT if found.hypothesis is None else found.hypothesis.turn
    # Only if nothing else explains the lines as well: a wrong turn would spoil a video that is right.
    if found.standing is Standing.NAMED and turn != AS_BUILT and found.alternative is None:
        note(f"{TURNED[turn]}; the reconstruction corrects this")
        known = arguments.options.calibration
        # one that does not hold the arms' orientation, or what depends on it, has nothing to be turned
        if known is not None and (known.orientation or known.alignment):
            moved = reoriented(recording.cut(first, count), known, turn)
            note(f"the calibration was made before that: {moved.words}")
            known = moved.calibration
        return replace(arguments, options=replace(arguments.options, turn=turn, calibration=known))
    note(f"the orientation is left as it is: {found.sentence}")
    return arguments


def _age_s() -> float:
    """Time since this command began: the age of its process, unless another program called it."""
    from acquire.cores import process_age_s

    # The age of a program that calls us, such as a test's, would be taken off the budget.
    program = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    return process_age_s() if "acquire" in (program.name, program.parent.name) else 0.0
