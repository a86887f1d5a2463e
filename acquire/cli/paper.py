"""``acquire paper``: reproduce the paper's figures from simulated recordings, on one page."""

from __future__ import annotations

import shlex
import shutil
import sys
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.durations import seconds
from acquire.cli.output import JsonFlag, note, print_json, print_table, say
from acquire.cli.places import PAGE, new_directory
from acquire.cli.progress import activity_progress
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.evaluate.paper.page import Drawn

# As `FIGURES` of acquire.evaluate.paper, whose import loads numpy: help does without it.
NAMES = ("fig6", "fig7", "fig8", "fig9", "fig10", "fig11")


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Simulation")(paper)


def paper(
    figures: Annotated[
        list[str] | None,
        typer.Argument(metavar="FIGURE", help=f"Figures: {', '.join(NAMES)}. Default: all of them."),
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="New directory for the page and all its data.")
    ] = Path("acquire-paper"),
    preset: Annotated[
        str, typer.Option(metavar="PRESET", help="Effort: fast, balanced or best.")
    ] = "balanced",
    solver: Annotated[
        str, typer.Option(metavar="SOLVER", help="Solver: admm, or twist (the paper's).")
    ] = "admm",
    budget: Annotated[
        float | None,
        typer.Option(
            parser=seconds, metavar="TIME", help="Time limit for each reconstruction. Default: no limit."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the exposure code.")] = 1,
    recording: Annotated[
        str | None,
        typer.Option(
            metavar="RECORDING",
            help="Make fig9 from this recording of Scene #1, by any instrument, instead of a simulated one.",
        ),
    ] = None,
    first_line: Annotated[
        int | None,
        typer.Option(
            help="With --recording: number of the first line to use, as counted by the trigger. Default: the "
            "first one."
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Record, reconstruct and draw figures of the paper, and compare them with its statements.

    With --recording, Fig. 9 is made from a recording of your own, corrected by the calibration in it. The
    scene must have one lamp in each quarter of the field: three that blink at 5, 2.5 and 1 kHz, and one that
    is constant. They are identified by their light.

    Example: [bold]acquire paper fig9[/]
    """
    chosen = list(dict.fromkeys(figures or NAMES))
    if wrong := [name for name in chosen if name not in NAMES]:
        raise UsageError(f"there is no figure {wrong[0]!r}", possible=", ".join(NAMES))
    if recording is not None:
        # The other figures show scenes of their own, of which a recording has none.
        if figures not in (None, [], ["fig9"]):
            raise UsageError(f"{', '.join(figures)} cannot be made from a recording", possible="fig9")
        chosen = ["fig9"]
    elif first_line is not None:
        raise UsageError(
            "--first-line has no effect without --recording", possible="both, or neither of them"
        )
    if budget is not None and not budget > 0:
        raise UsageError(f"a budget of {budget:g} s is out of range", possible="more than 0")
    from acquire.cores import idle_cores, limit_blas
    from acquire.evaluate.paper import Studio, make
    from acquire.evaluate.paper.fig9_recorded import figure_of
    from acquire.evaluate.paper.page import draw, write_page
    from acquire.recon.solver import preset_iterations
    from acquire.reconstruct import Options
    from acquire.store import open_recording

    # Raises for an unknown name, before a scene is recorded for it.
    preset_iterations(solver, preset)
    options = Options(preset, solver, None, budget)  # type: ignore[arg-type]  # checked above
    made: list[Drawn] = []
    # Threads of BLAS spin while they wait for cores that other programs use.
    with new_directory(out), activity_progress() as report, limit_blas(idle_cores()):
        for name in chosen:
            # The name is bound here and now: the loop goes on to the next.
            studio = Studio(out, options, seed, lambda text, name=name: report(f"{name}: {text}"))  # type: ignore[misc]
            with _whole_figure(out):
                figure = (
                    make(name, studio)
                    if recording is None
                    else figure_of(open_recording(recording), studio, first_line)
                )
                # Drawn at once, so that only one figure's videos are in memory.
                made.append(draw(figure, out, studio.host.busyness()))
            # After every figure, so that an interrupted run leaves a page with those it has made.
            page = write_page(
                made,
                studio,
                f"acquire {shlex.join(sys.argv[1:])}",
                datetime.now(UTC),
                recording,
                missing=chosen[len(made) :],
            )
    if json:
        print_json({"page": str(page), "figures": [each.facts for each in made]})
        return
    for each in made:
        say(f"Fig. {each.facts['name'][3:]}  {each.facts['title']}")
        shown = ("what", "paper", "ours", "verdict", "by")
        rows = [tuple(row[name] for name in shown) for row in each.facts["rows"]]
        print_table(("", "paper", "here", "verdict", "detail"), rows)
        say()
    say(f"page  {page}")


@contextmanager
def _whole_figure(out: Path) -> Iterator[None]:
    """Remove the files of a figure from ``out`` if it is not finished: the page says that it is missing."""
    before = set(out.iterdir())
    try:
        yield
    except BaseException:
        for path in set(out.iterdir()) - before:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        if (page := out / PAGE).exists():
            note(f"{page} has the figures made so far, and names those that are missing")
        raise
