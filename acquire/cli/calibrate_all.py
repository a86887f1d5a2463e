"""``acquire calibrate all``: the guided sequence on a running daemon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.calibrate.guide import AT_ONCE, LINES, MOST_LINES, OPTIONAL, PSF, Step
from acquire.cli.calibrate_live import instrument, kept, record, tell_finding, wait_for_enter
from acquire.cli.control import SocketOption
from acquire.cli.output import JsonFlag, note, print_json, print_warning, say
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.calibrate.calibration import Calibration, Finding
    from acquire.calibrate.exposure import Exposure
    from acquire.client import Client, Setup

TRIES = 3
"""Of a step, where somebody can mend what was wrong."""


def calibrate_all(
    out: Annotated[
        str, typer.Option("--out", metavar="CAL", help="The calibration: new, or one that is added to.")
    ],
    directory: Annotated[
        Path, typer.Option(metavar="DIR", help="Directory of the recordings, which stay; made if absent.")
    ] = Path("calibration-recordings"),
    lines: Annotated[
        int, typer.Option(min=64, max=MOST_LINES, help="Number of lines of each recording.")
    ] = LINES,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="STEP", help="Only this step: dark, flat, target or psf; repeatable; absent: all but psf."
        ),
    ] = None,
    psf: Annotated[
        bool, typer.Option("--psf", help="In the end the optics' blur, too, from edges that are put in.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask nothing: everything is in place already, or moves by itself.")
    ] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Calibrate the instrument that the daemon runs: dark, flat, target in turn, psf where wanted.

    Says before each recording what to do, and waits for Enter. What was found is kept step by step; begun
    again with --only, it goes on where it ended. The instrument is left as it was: armed or not.

    Example: [bold]acquire calibrate all --out cal.zarr[/]
    """
    names = [step.name for step in (*AT_ONCE, *OPTIONAL)]
    if wrong := [each for each in only or () if each not in names]:
        raise UsageError(f"step {wrong[0]!r} is not known", possible=", ".join(names))
    steps = [step for step in AT_ONCE if not only or step.name in only]
    if psf or PSF.name in (only or ()):
        steps.append(PSF)
    found: list[Finding] = []
    with instrument(socket, directory) as daemon:
        if PSF in steps:
            _refuse_edges_unseen(daemon.setup())
        for step in steps:
            found += _step(daemon, step, out, directory, lines, ask=not yes, quiet=json)
    if json:
        print_json({"calibration": out, "steps": {each.step: each.facts for each in found}})
    else:
        say(f"kept in  {out}; acquire calibrate show {out} --out DIR draws it")


def _refuse_edges_unseen(setup: Setup) -> None:
    """UsageError, before the first recording, on a rig whose lines cannot tell how wide the optics blur."""
    if setup.config["cameras"]["layout"] == "fibre":
        raise UsageError(
            "psf: the rig has a fibre, and edges are not followed from band to band",
            possible="a rig without a fibre",
            hint="leave psf out",
        )
    if setup.config["code"]["kind"] == "constant":
        raise UsageError(
            "psf: the rig's code is constant, which does not tell the rows of a scene apart",
            possible="a pseudo-random code: code.kind = 'prbs'",
            hint="leave psf out, or give the rig such a code",
        )


def _step(
    daemon: Client, step: Step, out: str, directory: Path, lines: int, *, ask: bool, quiet: bool
) -> list[Finding]:
    """Record, look, keep; again where it failed and somebody is there."""
    for left in reversed(range(TRIES)):
        note(f"{step.name}: {step.prepare} {lines} lines.")
        if ask:
            wait_for_enter()
        try:
            exposure = record(daemon, step.name, directory, lines, code=step.code)
            found = []
            for look in _looks(step, exposure, out):
                found.append(kept(out, exposure, look))
                if not quiet:
                    tell_finding(found[-1])
                    say()
        except UsageError as error:
            if not (ask and left):
                raise
            print_warning(f"{step.name}: {error}")
            note("again:")
            continue
        return found
    raise AssertionError  # the last try returns or raises


def _looks(step: Step, exposure: Exposure, out: str) -> Iterator[Callable[[Calibration], Finding]]:
    """What is to be found in a step's recording, given what is known; a ramp told more than a flat does."""
    from acquire.calibrate import columns, open_calibration, psf, target
    from acquire.calibrate.transfer import transfer

    looks: dict[str, Callable[[Calibration], Finding]] = {
        "dark": lambda _: columns.dark(exposure),
        "flat": lambda known: columns.flat(exposure, known),
        "transfer": lambda known: transfer([exposure], known),
        "orientation": lambda known: target.orientation(exposure, known),
        "align": lambda known: target.alignment(exposure, known),
        "psf": lambda known: psf.psf(exposure, known),
    }
    for name in step.finds:
        if name != "transfer" or "linearity" not in open_calibration(out).steps:
            yield looks[name]
