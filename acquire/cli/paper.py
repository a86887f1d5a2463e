"""``acquire paper``: the paper's figures from simulated recordings, in one page."""

from __future__ import annotations

import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.durations import seconds
from acquire.cli.output import JsonFlag, print_json, print_table, say
from acquire.cli.places import new_directory
from acquire.cli.progress import told
from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.evaluate.paper import PaperFigure, Studio
    from acquire.evaluate.paper.page import Drawn

NAMES = ("fig6", "fig7", "fig8", "fig9", "fig10", "fig11")


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Simulation")(paper)


def paper(
    figures: Annotated[
        list[str] | None, typer.Argument(metavar="FIGURE...", help=f"{', '.join(NAMES)}; else all.")
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="New directory.")] = Path("acquire-paper"),
    preset: Annotated[str, typer.Option(help="Effort: fast, balanced or best.")] = "balanced",
    solver: Annotated[str, typer.Option(help="Solver: admm, or twist, which is the paper's.")] = "admm",
    budget: Annotated[
        float | None,
        typer.Option(parser=seconds, metavar="TIME", help="Wall time that each reconstruction may take."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the exposure code.")] = 1,
    recording: Annotated[
        str | None,
        typer.Option(
            metavar="RECORDING",
            help="A recording of Scene #1 by any instrument, for fig9; none is simulated.",
        ),
    ] = None,
    first_line: Annotated[
        int | None,
        typer.Option(help="The trigger's number of that recording's line to begin with; else the first."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Record, reconstruct and draw figures of the paper, beside what it says of them.

    With --recording, Fig. 9 from a recording of your own: four lamps in the quarters of the field, 5, 2.5 and
    1 kHz and constant, recognised by their light; corrected by the calibration that the recording carries.

    Example: [bold]acquire paper fig9[/]
    """
    chosen = list(dict.fromkeys(figures or NAMES))
    if wrong := [name for name in chosen if name not in NAMES]:
        raise UsageError(f"figure {wrong[0]!r} is not known", possible=", ".join(NAMES))
    if recording is not None:
        if figures not in (None, [], ["fig9"]):
            raise UsageError(f"{', '.join(figures)} cannot be made from a recording", possible="fig9")
        chosen = ["fig9"]
    from acquire.cores import idle_cores, limit_blas
    from acquire.evaluate.paper import Studio, make
    from acquire.evaluate.paper.page import draw, write_page
    from acquire.reconstruct import Options

    options = Options(preset, solver, None, budget)  # type: ignore[arg-type]  # checked there
    made: list[Drawn] = []
    with new_directory(out), told() as tell, limit_blas(idle_cores()):
        for name in chosen:
            studio = Studio(out, options, seed, lambda text, name=name: tell(f"{name}: {text}"))  # type: ignore[misc]
            figure = make(name, studio) if recording is None else _recorded(recording, studio, first_line)
            made.append(draw(figure, out, studio.host.busyness()))
            page = write_page(
                made, studio, f"acquire {shlex.join(sys.argv[1:])}", datetime.now(UTC), recording
            )
    if json:
        print_json({"page": str(page), "figures": [each.facts for each in made]})
        return
    for each in made:
        say(f"Fig. {each.facts['name'][3:]}  {each.facts['title']}")
        shown = ("what", "paper", "ours", "verdict", "by")
        rows = [tuple(row[name] for name in shown) for row in each.facts["rows"]]
        print_table(("", "the paper", "here", "against it", "by"), rows)
        say()
    say(f"page  {page}")


def _one_of_a_recording(figures: list[str] | None) -> list[str]:
    if figures not in (None, [], ["fig9"]):
        raise UsageError(f"{', '.join(figures)} cannot be made from a recording", possible="fig9")
    return ["fig9"]


def _recorded(place: str, studio: Studio, first_line: int | None) -> PaperFigure:
    import matplotlib as mpl

    from acquire.evaluate.paper.fig9_recorded import figure_of
    from acquire.evaluate.themed import STYLE
    from acquire.store import open_recording

    with mpl.rc_context(STYLE):
        return figure_of(open_recording(place), studio, first_line)
