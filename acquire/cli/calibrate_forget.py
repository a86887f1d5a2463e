"""``acquire calibrate forget``: take steps out of a calibration."""

from __future__ import annotations

from typing import Annotated

import typer

from acquire.cli.output import JsonFlag, print_facts, print_json
from acquire.cli.places import calibration_place


def forget(
    steps: Annotated[
        list[str],
        typer.Argument(
            metavar="STEP",
            help="Steps to forget: dark, ambient, linearity, flat, transfer, orientation, align, psf, veil, "
            "delay.",
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            "--out",
            metavar="CAL",
            help="Calibration to change, NAME.zarr.",
            parser=calibration_place,
        ),
    ],
    json: JsonFlag = False,
) -> None:
    """Forget what a step has measured, such as a veil of a target whose black was not black.

    Reconstructions then no longer correct it. The step's values, facts and warnings are removed, and all
    others stay as they are. A step with which others were measured can only be forgotten together with them.
    A step that is repeated replaces its earlier result, and need not be forgotten first. Recordings keep the
    copies that they carry.

    Example: [bold]acquire calibrate forget veil --out cal.zarr[/]
    """
    from acquire.calibrate.file import change_calibration
    from acquire.calibrate.forget import without

    left = list(change_calibration(out, lambda known: without(known, steps, out)).steps)
    gone = list(dict.fromkeys(steps))
    if json:
        print_json({"calibration": out, "forgotten": gone, "steps": left})
        return
    print_facts({"forgotten": ", ".join(gone), "left": ", ".join(left), "saved in": out})
