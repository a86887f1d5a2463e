"""``acquire paper``: the paper's figures from simulated recordings, in one page."""

from __future__ import annotations

import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from acquire.cli.durations import seconds
from acquire.cli.output import JsonFlag, print_json, print_table, say
from acquire.cli.places import new_directory
from acquire.cli.progress import told
from acquire.errors import UsageError

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
    json: JsonFlag = False,
) -> None:
    """Record, reconstruct and draw figures of the paper, beside what it says of them.

    Example: [bold]acquire paper fig9[/]
    """
    chosen = list(dict.fromkeys(figures or NAMES))
    if wrong := [name for name in chosen if name not in NAMES]:
        raise UsageError(f"figure {wrong[0]!r} is not known", possible=", ".join(NAMES))
    from acquire.cores import idle_cores, limit_blas
    from acquire.evaluate.paper import Studio, make
    from acquire.evaluate.paper.page import draw, summarise, write_page
    from acquire.reconstruct import Options

    options = Options(preset, solver, None, budget)  # type: ignore[arg-type]  # checked there
    made: list[dict[str, Any]] = []
    pictures: dict[str, Path] = {}
    with new_directory(out), told() as tell, limit_blas(idle_cores()):
        for name in chosen:
            studio = Studio(out, options, seed, lambda text, name=name: tell(f"{name}: {text}"))  # type: ignore[misc]
            figure = make(name, studio)
            pictures |= draw(figure, out)
            made.append(summarise(figure))
            page = write_page(
                made, pictures, studio, f"acquire {shlex.join(sys.argv[1:])}", datetime.now(UTC)
            )
    if json:
        print_json({"page": str(page), "figures": made})
        return
    for each in made:
        say(f"Fig. {each['name'][3:]}  {each['title']}")
        print_table(("", "the paper", "here"), [tuple(row.values()) for row in each["rows"]])
        say()
    say(f"page  {page}")
