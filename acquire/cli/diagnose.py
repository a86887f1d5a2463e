"""``acquire diagnose``: check the lines of a recording against its own description."""

from __future__ import annotations

from typing import Annotated

import typer

from acquire.cli.output import JsonFlag, print_facts, print_json, print_table, say
from acquire.cli.recordings import PlaceArgument
from acquire.cli.stretch import FromOption, ToOption, lines_between
from acquire.cli.tiles import TileOption, tile_of

WRONG = 1
"""Exit code if the lines contradict the recording's description."""


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Recordings")(diagnose)


def diagnose(
    recording: PlaceArgument,
    first_line: Annotated[
        int | None,
        typer.Option(
            help="Number of the first line, as counted by the trigger. Default: lines in the middle."
        ),
    ] = None,
    lines: Annotated[int | None, typer.Option(help="Number of lines. Default: a few hundred.")] = None,
    begin: FromOption = None,
    end: ToOption = None,
    tile: TileOption = None,
    calibration: Annotated[
        str | None,
        typer.Option(
            metavar="CAL", help="Calibration NAME.zarr, or 'none'. Default: the one in the recording."
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Check a recording's lines against its code, geometry and orientation, and report what is wrong.

    The hypotheses are: the code is inverted, shifted by sub-steps or lines, or belongs to another run; the
    arms are swapped or mirrored; the number of sub-steps per line differs; an arm is stuck or dark; the black
    level, ambient light or gains are wrong; there is too little light. For each hypothesis the table shows
    the gain in log likelihood over the recording's description, that gain in standard errors, and how many
    times better the arms agree than under wrong codes. The exit code is 1 if something is wrong. Behind a
    fibre one tile is tested: the one given, or the one whose lines have the most contrast.

    Example: [bold]acquire diagnose run.zarr[/]
    """
    from acquire.calibrate.choose import choose
    from acquire.reconstruct.diagnose import diagnose_recording, diagnosed_range
    from acquire.reconstruct.liveliest import representative_tile
    from acquire.store import open_recording

    opened = open_recording(recording)
    chosen = choose(opened, calibration)
    first, count = diagnosed_range(opened, *lines_between(opened, first_line, lines, begin, end))
    known, named = None if chosen is None else chosen.calibration, tile_of(opened, tile)
    # moving=False: a diagnosis needs contrast, and not change.
    seen = representative_tile(opened, () if named is None else (named,), (first, count), known, moving=False)
    found = diagnose_recording(opened, first, count, known, seen)
    whose = {} if seen is None else {"tile": str(seen)}
    if json:
        facts = {"recording": str(opened), "first_line": first, "lines": count, **whose}
        print_json(facts | found.to_dict())
    else:
        print_facts(
            {
                "lines": f"{first} to {first + count - 1}",
                **whose,
                "verdict": f"{found.standing}: {found.sentence}",
                # Both arms may give rise to the same one.
                **{
                    f"also ({kind})": "; ".join(each.words for each in found.suspicions if each.kind == kind)
                    for kind in dict.fromkeys(each.kind for each in found.suspicions)
                },
            }
        )
        rows = [
            (
                # 0: the recording's own description, with which the others are compared.
                f"{row.likelier:+.0f}" if row.likelier else "0",
                f"{row.errors:+.1f}" if row.likelier else "",
                f"{row.agreement:.1f}" if row.agreement else "",
                row.name,
            )
            for row in found.rows
        ]
        if rows:
            say()
            print_table(("log likelihood", "std errors", "agreement", "hypothesis"), rows)
    if found.wrong:
        # Without a message: the verdict has been printed.
        raise typer.Exit(WRONG)
