"""``acquire reconstruct``: from lines to a video."""

from __future__ import annotations

import re
import sys
import time
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.completion import plans
from acquire.cli.durations import seconds
from acquire.cli.interrupts import first_interrupt_asks
from acquire.cli.output import JsonFlag, note, print_facts, print_json, print_table, print_warning, say
from acquire.cli.progress import stage_progress
from acquire.cli.recordings import PlaceArgument
from acquire.cli.stretch import FirstLineOption, FromOption, LinesOption, ToOption
from acquire.cli.tiles import TilesOption, tiles_of
from acquire.errors import EXIT_INTERRUPTED, UsageError

if TYPE_CHECKING:
    from acquire.cli.reconstruct_request import Asked, Prepared
    from acquire.fibre import Tile
    from acquire.reconstruct import Options, Outcome, VideoRequest
    from acquire.store import Recording


QUICKER = "--from and --to (a part), --preview (seconds), --preset fast, --budget SECONDS, or larger voxels"

PROCESSES_FROM = 5.0
"""Budgets shorter than so many times a process' start are spent in this one."""
LEAST_S = 1e-3
SAID_S = 0.05


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Recordings")(reconstruct)


def reconstruct(
    recording: PlaceArgument,
    out: Annotated[
        str | None, typer.Option(metavar="VIDEO", help="New video: a directory NAME.zarr, or a URL.")
    ] = None,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    spatial_merge: Annotated[
        int, typer.Option("--spatial-merge", "--nm", help="N_m, voxel side in fine pixels.")
    ] = 3,
    temporal_merge: Annotated[
        int, typer.Option("--temporal-merge", "--tm", help="T_m, sub-steps per frame.")
    ] = 1,
    voxels: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NMxTM",
            help="Voxels N_m x T_m, as 1x820; repeatable: a video of each, of the same lines.",
        ),
    ] = None,
    plan: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            autocompletion=plans,
            help="Plan (TOML) of sub-segments with voxels of their own, or the name of a built-in one.",
        ),
    ] = None,
    segment: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LENGTH:NMxTM",
            help="One sub-segment of a plan, by lines or time: 712:3x4, 1.1ms:1x230, or :3x4 for the rest.",
        ),
    ] = None,
    auto: Annotated[bool, typer.Option("--auto", help="Propose a plan from the lines, and say why.")] = False,
    save_plan: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File that the plan is written to.")
    ] = None,
    ends: Annotated[
        str | None,
        typer.Option(help="Frames at the ends: trusted, or whole (sampled in part, too)."),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="Effort: fast, balanced or best; absent: balanced, or what `acquire tradeoff` found best."
        ),
    ] = None,
    solver: Annotated[
        str,
        typer.Option(help="admm; twist, the paper's; twist-band; or one that acquire plugins lists."),
    ] = "admm",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Option of the solver's own; repeatable."),
    ] = None,
    denoiser: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Denoiser in the place of total variation: haar, or another that is installed.",
        ),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(parser=seconds, metavar="TIME", help="Wall time that the whole command may take."),
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Number of iterations; absent: the preset's.")
    ] = None,
    dtype: Annotated[
        str, typer.Option(help="Numbers that are computed with: float32 or float64.")
    ] = "float32",
    device: Annotated[str, typer.Option(help="Processor: cpu, or gpu (CUDA by way of CuPy).")] = "cpu",
    calibration: Annotated[
        str | None,
        typer.Option(metavar="CAL", help="Calibration NAME.zarr, or none; absent: the recording's own."),
    ] = None,
    explain: Annotated[
        bool, typer.Option("--explain", help="Only say what each part of the calibration gives and costs.")
    ] = False,
    try_orientations: Annotated[
        bool,
        typer.Option(
            "--try-orientations", help="Swap or mirror the arms if the lines say clearly that they are."
        ),
    ] = False,
    tiles: TilesOption = None,
    search: Annotated[
        str | None,
        typer.Option(
            help="Who looks for prior and weight: each tile or sub-segment, or one for all (shared); absent: "
            "shared among tiles."
        ),
    ] = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="Make a coarse video in a second or two.")
    ] = False,
    workers: Annotated[int | None, typer.Option(help="Number of processes; absent: one per core.")] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Scheduler of a Dask cluster that computes: tcp://HOST:8786."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Reconstruct a stretch of a recording as a video (OME-Zarr), with voxels chosen now.

    Ctrl-C keeps the best result so far.

    Example: [bold]acquire reconstruct run.zarr --out video.zarr --from 52ms --to 57.98ms --nm 3 --tm 1[/]
    """
    from acquire.arrays import open_arrays
    from acquire.calibrate.choose import choose
    from acquire.cli.reconstruct_explain import explain_calibration
    from acquire.cli.reconstruct_request import Asked, prepare
    from acquire.config import parse_settings
    from acquire.recon.denoisers import open_denoiser
    from acquire.recon.solver import open_solver
    from acquire.reconstruct import Options
    from acquire.store import open_recording
    from acquire.store.delivery import check_new_place

    _check_something_asked(out, auto, explain)
    began = time.monotonic() - _age_s()
    solver_options = parse_settings(settings or ())
    open_solver(solver, solver_options)
    if denoiser is not None:
        open_denoiser(denoiser)
    open_arrays(device if dask is None else "cpu", dtype)  # a cluster's devices are not here
    opened = open_recording(recording)
    asked_tiles = _tiles_asked(opened, tiles, turned=try_orientations)
    chosen = choose(opened, calibration)
    asked = Asked(
        first_line=first_line,
        lines=lines,
        begin=begin,
        end=end,
        voxels=tuple(voxels or [f"{spatial_merge}x{temporal_merge}"]),
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
            dtype=dtype,  # type: ignore[arg-type]  # checked there
            device=device,
            calibration=None if chosen is None else chosen.calibration,
            solver_options=solver_options,
            denoiser=denoiser,
            shared=_shared(search),
        ),
        tiles=asked_tiles,
    )
    explained = explain_calibration(opened, chosen, asked, wanted=explain, json=json and out is None)
    if explained and not (out or auto):
        return
    asked = _turned(opened, asked, wanted=try_orientations)
    prepared = prepare(opened, asked)
    if not json:
        _print_prepared(prepared)
    if out is None:
        return
    places = [_beside(out, suffix) for suffix in prepared.requests]
    for place in places:
        check_new_place(place)
    if workers is None and (preview or (budget is not None and budget < PROCESSES_FROM * _age_s())):
        workers = 1  # processes take longer to start than that: as long as this one, or longer
    outcomes = []
    for number, (place, request) in enumerate(zip(places, prepared.requests.values(), strict=True)):
        options = _share(prepared.options, time.monotonic() - began, len(places) - number)
        outcomes.append(_run(opened, request, place, options, (workers, dask), began))
        if outcomes[-1].interrupted:
            break
    _report(outcomes, json=json, brief=preview)
    if any(outcome.interrupted for outcome in outcomes):
        raise typer.Exit(EXIT_INTERRUPTED)


def _check_something_asked(*wanted: object) -> None:
    if not any(wanted):
        raise UsageError(
            "reconstruct needs --out, where the video goes",
            possible="--out NAME.zarr; --auto alone shows a plan, --explain what a calibration gives",
        )


def _shared(search: str | None) -> bool | None:
    if search not in {None, "each", "shared"}:
        raise UsageError(f"--search {search} is not known", possible="each, shared")
    return None if search is None else search == "shared"


def _tiles_asked(recording: Recording, text: str | None, *, turned: bool) -> tuple[Tile, ...]:
    """Those of a scene behind a fibre, whose arms cannot be turned tile by tile."""
    tiles = tiles_of(recording, text)
    if tiles and turned:
        raise UsageError(
            "--try-orientations cannot turn lines behind a fibre: in an arm that is mirrored, other columns "
            "see a tile",
            possible="`acquire diagnose --tile`, which says whether they are; [fibre] of the rig, which says "
            "where bands lie",
        )
    return tiles


def _turned(recording: Recording, asked: Asked, *, wanted: bool) -> Asked:
    """With the orientation that the lines bear out, where the evidence is clear; says so either way."""
    if not wanted:
        return asked
    from acquire.recon.diagnosis import TURNED
    from acquire.recon.hypotheses import AS_BUILT
    from acquire.recon.search import Standing
    from acquire.reconstruct.diagnose import diagnose_recording, diagnosed_range

    first, count = diagnosed_range(recording, asked.first_line, asked.lines)
    found = diagnose_recording(recording, first, count, asked.options.calibration)
    turn = AS_BUILT if found.hypothesis is None else found.hypothesis.turn
    if found.standing is Standing.NAMED and turn != AS_BUILT and found.alternative is None:
        note(f"{TURNED[turn]}; reconstructed so")
        return replace(asked, options=replace(asked.options, turn=turn))
    note(f"orientation left as it is: {found.sentence}")
    return asked


def _beside(out: str, suffix: str) -> str:
    """NAME.zarr as NAME-1x820.zarr."""
    return re.sub(r"(\.[^./]*)?$", rf"-{suffix}\1", out.rstrip("/"), count=1) if suffix else out


def _age_s() -> float:
    """Since this command began: with its process, unless another program called it."""
    from acquire.cores import process_age_s

    program = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    return process_age_s() if "acquire" in (program.name, program.parent.name) else 0.0


def _share(options: Options, elapsed_s: float, videos: int) -> Options:
    """The budget until the next of so many videos is there, from the command's start on."""
    if options.budget_s is None:
        return options
    left_s = options.budget_s - elapsed_s
    return replace(options, budget_s=max(elapsed_s + left_s / videos, LEAST_S))


def _run(
    recording: Recording,
    request: VideoRequest,
    out: str,
    options: Options,
    where: tuple[int | None, str | None],
    began: float,
) -> Outcome:
    """``where``: processes, or a cluster; ``began`` is when the budget did."""
    from acquire.reconstruct import Watcher, combine, open_pool

    tasks, (workers, cluster) = len(request.stretches) * max(1, len(request.tiles)), where
    at_once = workers or (None if options.device == "cpu" else 1)  # one process fills a GPU
    with (
        first_interrupt_asks("finishing the sub-segments under way, as far as they came") as interrupted,
        stage_progress(
            f"reconstructing {PurePosixPath(out).name}", QUICKER if options.budget_s is None else ""
        ) as advance,
    ):
        watcher = Watcher(tasks, advance, interrupted.is_set)
        with open_pool(tasks, at_once, cluster, watcher) as pool:
            return combine(recording, request, out, options, pool, watcher, began)


def _report(outcomes: list[Outcome], *, json: bool, brief: bool) -> None:
    """``brief``: of a preview, whose voxels cannot explain the lines, which is no news."""
    if json:
        facts = [{"path": str(each.path), "shape": each.shape, **each.provenance} for each in outcomes]
        print_json(facts[0] if len(facts) == 1 else facts)
        return
    for outcome in outcomes:
        print_facts(_readable(outcome))
        segments = outcome.provenance["segments"]
        if brief:
            continue
        if len(segments) > 1:
            say()
            _print_segments(segments)
        for text in outcome.provenance["warnings"]:
            print_warning(text)


def _readable(outcome: Outcome) -> dict[str, Any]:
    from acquire.showing import error_in_words

    facts = outcome.provenance
    first, end = facts["trusted"]
    quality, prediction = facts["quality"], facts["quality"]["prediction"]
    done, of = len(facts["segments"]), facts["segments_asked"]
    trusted = sum(part["trusted"] for part in facts["segments"])
    nothing = "every frame is sampled in part" if trusted else "no sub-segment was solved to its end"
    return {
        "video": f"{outcome.path}, {' × '.join(map(str, outcome.shape))} (time, row, column)",
        "interrupted": f"holds {done} of {of} sub-segments, {done - trusted} of them broken off"
        if outcome.interrupted
        else f"the budget ended after {done} of {of} sub-segments"
        if outcome.cut
        else None,
        "tiles": _tiles(facts),
        "search": _searched(facts["choice"]),
        "trusted": f"frames {first} to {end - 1}" if end > first else f"none: {nothing}",
        "solver": f"{facts['solver']}, {_iterations(facts)}, {facts['seconds']:.1f} s",
        "corrected": ", ".join(facts["calibration"]["corrected"]) if facts["calibration"] else None,
        "compiled": f"for {facts['compiled_s']:.1f} s of these, once after an installation"
        if facts["compiled_s"] >= SAID_S
        else None,
        "misfit": f"{quality['misfit']:.2%} of the samples' RMS",
        "prediction": None if prediction is None else f"{prediction:.2%} at samples kept from the solver",
        "error": error_in_words(facts["error"]),
        "noise": None if quality.get("noise") is None else _beside_noise(quality),
        "coverage": f"{quality['coverage']:.2%} of the samples usable",
    }


def _tiles(facts: dict[str, Any]) -> str | None:
    """Of a scene behind a fibre: which, and how many are there."""
    if not (tiles := facts["tiles"]):
        return None
    there = len(facts["segments"]) * len(tiles) // facts["segments_asked"]
    which = tiles[0] if len(tiles) == 1 else f"{tiles[0]} to {tiles[-1]}"
    return f"{which}, {there} of {len(tiles)}"


def _searched(choice: dict[str, list[str]] | None) -> str | None:
    """Who looked for prior and weight, of those that one choice was handed to."""
    if choice is None or not choice["kept"] + choice["changed"]:
        return None
    others = f"kept by {len(choice['kept'])}"
    if choice["changed"]:
        others += f", changed by {len(choice['changed'])} ({', '.join(choice['changed'])})"
    return f"by {', '.join(choice['searched'])} for all; {others}"


def _beside_noise(quality: dict[str, Any]) -> str:
    from acquire.recon import Quality

    known = {key: float("nan") if value is None else value for key, value in quality.items()}
    return f"{quality['noise']:.2%} is the cameras': the lines are {Quality(**known).standing}"


def _iterations(facts: dict[str, Any]) -> str:
    done, asked = facts["iterations"], facts["iterations_asked"]
    return f"{done} iterations" if done >= asked else f"{done} of {asked} iterations"


def _print_segments(segments: list[dict[str, Any]]) -> None:
    rows = [
        (
            part["name"] or (f"tile {part['tile']}" if part["tile"] else number),
            f"{part['spatial_merge']}x{part['temporal_merge']}",
            part["end_substep"] - part["begin_substep"],
            f"{part['first_line']} to {part['first_line'] + part['lines'] - 1}",
            part["iterations"],
            f"{part['seconds']:.1f}",
            f"{part['quality']['misfit']:.2%}",
            "yes" if part["trusted"] else "no",
        )
        for number, part in enumerate(segments, 1)
    ]
    print_table(
        ("segment", "voxels", "sub-steps kept", "lines", "iterations", "seconds", "misfit", "trusted"), rows
    )


def _print_prepared(prepared: Prepared) -> None:
    if prepared.learned:
        note(f"preset {prepared.options.preset}: {prepared.learned}")
    if prepared.plan is not None:
        rows = [
            (part.name or number, part.length, f"{part.spatial_merge}x{part.temporal_merge}", part.why)
            for number, part in enumerate(prepared.plan.segments, 1)
        ]
        print_table(("segment", "length", "voxels", "because"), rows)
        say()
