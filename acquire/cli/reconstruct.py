"""``acquire reconstruct``: from lines to a video."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.output import JsonFlag, print_facts, print_json, print_warning
from acquire.cli.progress import stage_progress
from acquire.cli.recordings import PlaceArgument

if TYPE_CHECKING:
    from typing import Any


DOUBTFUL_PREDICTION = 0.3
"""Good reconstructions predict within a tenth; a wrong code or swapped arms come to half and more."""


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Recordings")(reconstruct)


def reconstruct(
    recording: PlaceArgument,
    out: Annotated[Path, typer.Option(metavar="VIDEO", help="New video, a directory NAME.zarr.")],
    first_line: Annotated[
        int | None, typer.Option(help="The trigger's number; else the recording's first.")
    ] = None,
    lines: Annotated[int, typer.Option(help="How many lines, L_R.")] = 263,
    spatial_merge: Annotated[
        int, typer.Option("--spatial-merge", "--nm", help="N_m, voxel side in fine pixels.")
    ] = 3,
    temporal_merge: Annotated[
        int, typer.Option("--temporal-merge", "--tm", help="T_m, sub-steps per frame.")
    ] = 1,
    preset: Annotated[str, typer.Option(help="fast or balanced.")] = "balanced",
    solver: Annotated[str, typer.Option(help="admm, or twist: the paper's.")] = "admm",
    budget: Annotated[float | None, typer.Option(metavar="SECONDS", help="Stop iterating in time.")] = None,
    json: JsonFlag = False,
) -> None:
    """Reconstruct a stretch of a recording as a video (OME-Zarr), with voxels chosen now.

    Example: [bold]acquire reconstruct run.zarr --out video.zarr --first-line 4000 --nm 3 --tm 1[/]
    """
    from acquire.recon import reconstruct as solve
    from acquire.reconstruct import save_reconstruction
    from acquire.store import open_recording
    from acquire.store.files import check_new_path

    check_new_path(out)
    opened = open_recording(recording)
    segment = opened.cut(opened.first_line if first_line is None else first_line, lines)
    with stage_progress(f"reconstructing {out.name}") as advance:
        result = solve(
            segment,
            spatial_merge,
            temporal_merge,
            preset,  # type: ignore[arg-type]  # checked there, with what is possible
            budget,
            lambda step: advance(step.iteration, step.iterations),
            solver=solver,  # type: ignore[arg-type]
        )
    provenance = save_reconstruction(out, result, opened, segment, spatial_merge)
    if json:
        print_json({"path": str(out), "shape": result.video.shape, **provenance})
        return
    print_facts(_readable(out, provenance, result.video.shape))
    if result.quality.prediction > DOUBTFUL_PREDICTION:
        print_warning(
            f"samples kept from the solver are predicted with an error of {result.quality.prediction:.0%}: "
            "do not trust the video before code, arms and losses are checked"
        )


def _iterations(facts: dict[str, Any]) -> str:
    done, asked = facts["iterations"], facts["iterations_asked"]
    return f"{done} iterations" if done == asked else f"{done} of {asked} iterations (stopped by the budget)"


def _readable(out: Path, facts: dict[str, Any], shape: tuple[int, ...]) -> dict[str, Any]:
    first, end = facts["trusted"]
    quality = facts["quality"]
    prediction = quality["prediction"]
    return {
        "video": f"{out}, {' × '.join(map(str, shape))} (time, row, column)",
        "trusted": f"frames {first} to {end - 1}" if end > first else "none: fewer lines than stages",
        "solver": f"{facts['solver']}, {_iterations(facts)}, {facts['seconds']:.1f} s",
        "misfit": f"{quality['misfit']:.2%} of the samples' RMS",
        "prediction": None if prediction is None else f"{prediction:.2%} at samples kept from the solver",
        "coverage": f"{quality['coverage']:.2%} of the samples usable",
    }
