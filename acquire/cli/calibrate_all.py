"""``acquire calibrate all``: the guided sequence of all calibration steps, on a running daemon."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.calibrate.guide import (
    AT_ONCE,
    BLACK,
    LINES,
    MOST_LINES,
    NOISE_LINES,
    OPTIONAL,
    PER_ROW,
    PSF,
    TARGET,
    VEIL,
    Step,
    lines_of,
)
from acquire.cli.calibrate_live import (
    instrument,
    print_finding,
    record,
    recordings_kept,
    save_finding,
    wait_for_enter,
)
from acquire.cli.control import SocketOption
from acquire.cli.output import JsonFlag, note, print_json, print_warning, say
from acquire.cli.places import calibration_place
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.calibrate.calibration import Calibration, Finding
    from acquire.calibrate.exposure import Exposure
    from acquire.client import Client

TRIES = 3
"""Attempts at a step if somebody is there to correct the cause of a failure."""
MISSING = {
    "psf": "the target does not show the optics' blur",
    "veil": "the target does not show the lens's veil",
}
"""What a target need not show."""
INSTEAD = {
    "psf": "nothing corrects it, unless it was measured before; acquire calibrate sheet draws a target that "
    "shows it if it is turned by 5 degrees at most, and acquire calibrate all --only psf measures it alone",
    "veil": "nothing corrects it, unless it was measured before; acquire calibrate all --only veil measures "
    "it alone, from more lines",
}
"""What to do if it does not."""


def calibrate_all(
    out: Annotated[
        str,
        typer.Option(
            "--out",
            metavar="CAL",
            help="Calibration to write, NAME.zarr. An existing one is extended.",
            parser=calibration_place,
        ),
    ],
    directory: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Directory for the recordings, which are kept. Created if needed."),
    ] = Path("calibration-recordings"),
    lines: Annotated[
        int | None,
        typer.Option(
            min=64,
            max=MOST_LINES,
            help=f"Number of lines of each recording. Default: {NOISE_LINES} of dark, flat and veil, "
            f"{LINES} of the others; at least {PER_ROW} per fine row if the scene has to be resolved.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="STEP",
            help="Do only this step: dark, flat, target, psf or veil. Repeatable. Default: the first three.",
        ),
    ] = None,
    black: Annotated[
        bool,
        typer.Option(
            "--black",
            help=BLACK,
        ),
    ] = False,
    psf: Annotated[
        bool,
        typer.Option(
            "--psf",
            help="Also measure the optical blur at the end, from a target of its own, if the first does not "
            "show it.",
        ),
    ] = False,
    veil: Annotated[
        bool,
        typer.Option(
            "--veil", help="Also measure the lens's veil at the end, from a target with black parts."
        ),
    ] = False,
    yes: Annotated[
        bool,
        typer.Option("--yes", help="Do not wait for Enter: every target is in place or moved automatically."),
    ] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Calibrate the instrument run by the daemon: dark, flat and target in turn.

    The target shows the orientation and alignment of the arms, and also the optical blur if it has slanted
    edges, as the sheet that acquire calibrate sheet draws. If not, the command says so, and goes on.

    The command gives instructions before each recording and waits for Enter. Results are saved after every
    step, so that --only can continue an interrupted calibration. Afterwards the instrument is armed or idle
    as it was before.

    Example: [bold]acquire calibrate all --out cal.zarr[/]
    """
    names = [step.name for step in (*AT_ONCE, *OPTIONAL)]
    if wrong := [each for each in only or () if each not in names]:
        raise UsageError(f"there is no step {wrong[0]!r}", possible=", ".join(names))
    # In the order of the guide, whatever the order of the options: later steps need earlier ones.
    steps = [_with_veil(step) if black else step for step in AT_ONCE if not only or step.name in only]
    if black and not any("veil" in step.tries for step in steps):
        raise UsageError(
            "--black says something of the target, which this sequence does not record",
            possible="--black with the step target",
        )
    wanted = ((PSF, psf), (VEIL, veil))
    optional = [step for step, asked in wanted if asked or step.name in (only or ())]
    steps += optional
    found: list[Finding] = []
    with instrument(socket, directory, out) as daemon:
        geometry = daemon.setup().config["geometry"]
        rows = geometry["stages"] * geometry["substeps"]
        if optional:  # refuse before the first recording if the rig cannot measure the optics
            name = optional[0].name
            config = daemon.setup().config
            if config["cameras"]["layout"] == "fibre":
                raise UsageError(
                    f"{name}: the rig has a fibre, which cuts the picture of a target into bands",
                    possible="a rig without a fibre",
                    hint=f"leave {name} out",
                )
            if config["code"]["kind"] == "constant":
                raise UsageError(
                    f"{name}: the rig's code is constant, so that the rows of a scene cannot be separated",
                    possible="a pseudo-random code: code.kind = 'prbs'",
                    hint=f"leave {name} out, or use a pseudo-random code in the rig file",
                )
        _refuse_out_of_order(steps, out)
        _warn_of_delays(out, daemon.setup().config["trigger"])
        for number, step in enumerate(steps):
            count = lines or lines_of(step, rows) or LINES
            with _telling_what_is_left(steps, number, out):
                found += _step(daemon, step, out, directory, count, ask=not yes, quiet=json)
    if json:
        print_json({"calibration": out, "steps": {each.step: each.facts for each in found}})
    else:
        say(f"saved in  {out}; to plot it: acquire calibrate show {out} --out DIR")


@contextmanager
def _telling_what_is_left(steps: list[Step], number: int, out: str) -> Iterator[None]:
    """If a step fails or is interrupted, say which ones were saved before it, and how to continue."""
    from acquire.store.source import source_of

    try:
        yield
    except BaseException:
        if number and source_of(out).exists():
            done = ", ".join(step.name for step in steps[:number])
            left = "".join(f" --only {step.name}" for step in steps[number:])
            black = " --black" if any("veil" in step.tries for step in steps[number:]) else ""
            note(f"{out} has {done}; to continue: acquire calibrate all{left}{black} --out {out}")
        raise


def _refuse_out_of_order(steps: list[Step], out: str) -> None:
    """Raise UsageError, before anything is recorded, for a step whose result needs one that was not made."""
    from acquire.calibrate import open_calibration
    from acquire.store.source import source_of

    made = set(open_calibration(out).steps) if source_of(out).exists() else set()
    for step in steps:
        if step.after and step.after not in made:
            raise UsageError(
                f"{step.name} needs the offsets of the columns first",
                possible=f"acquire calibrate all --only {step.after} --out {out}, then {step.name}",
            )
        made.update(step.finds)


def _warn_of_delays(out: str, trigger: dict[str, Any]) -> None:
    """Warn if the calibration has measured delays that the running rig does not have."""
    from acquire.calibrate import open_calibration
    from acquire.store.source import source_of

    if not source_of(out).exists():
        return
    wanted = open_calibration(out).steps.get("delay", {}).get("rig", {})
    now = {key: reduce(lambda table, name: table[name], key.split("."), trigger) for key in wanted}
    if now != wanted:
        keys = "; ".join(f"trigger.{key} = {ticks}" for key, ticks in wanted.items())
        print_warning(
            f"light and charge are apart: the rig lacks the delays that were measured, {keys}; put them into "
            "the rig file and restart the daemon, or measure the delays again"
        )


def _with_veil(step: Step) -> Step:
    return replace(step, tries=(*step.tries, "veil")) if step is TARGET else step


def _step(
    daemon: Client, step: Step, out: str, directory: Path, lines: int, *, ask: bool, quiet: bool
) -> list[Finding]:
    """Record, evaluate and save one step; repeat it after a failure if somebody is there (``ask``)."""
    for left in reversed(range(TRIES)):
        note(f"{step.name}: {step.prepare} {lines} lines.")
        if ask:
            wait_for_enter()
        try:
            exposure = record(daemon, step.name, directory, lines, out, code=step.code)
            found = []
            evaluations = _evaluations(exposure)
            with recordings_kept(out, [exposure], step.finds):
                wanted = _wanted(step, out)
            for number, name in enumerate(wanted):
                # Saved one by one: the next evaluation of the same recording builds on this one.
                found.append(
                    save_finding(
                        out, [exposure], evaluations[name], wanted[number:], first=not (step.after or number)
                    )
                )
                if not quiet:
                    print_finding(found[-1])
                    say()
            for name in step.tries:
                found = _tried(name, found, out, exposure, evaluations[name], quiet=quiet)
        except UsageError as error:
            # Without anybody to correct the cause, the next attempt would fail in the same way.
            if not (ask and left):
                raise
            # The error is the advice on what to correct before Enter is pressed again.
            print_warning(f"{step.name}: {error}")
            note("repeating this step:")
            continue
        return found
    raise AssertionError  # the last attempt returns or raises


def _tried(
    name: str,
    found: list[Finding],
    out: str,
    exposure: Exposure,
    evaluate: Callable[[Calibration], Finding],
    *,
    quiet: bool,
) -> list[Finding]:
    """Return the findings with one more if the scene shows it; otherwise the last step keeps a warning.

    A target need not show everything, and what it has shown is worth keeping.
    """
    try:
        more = save_finding(out, [exposure], evaluate, [name], first=False)
    except UsageError as error:
        text = f"{MISSING[name]}: {error.message}; {INSTEAD[name]}"
        # kept in the calibration, so that whoever reads it later knows what is missing, and why
        last = replace(found[-1], warnings=(*found[-1].warnings, text))
        save_finding(out, [exposure], lambda _: last, [name], first=False)
        print_warning(text)
        return [*found[:-1], last]
    if not quiet:
        print_finding(more)
        say()
    return [*found, more]


def _wanted(step: Step, out: str) -> list[str]:
    """Return the steps that a recording must complete.

    The transfer is left out if a ramp was recorded (step linearity), which determines it better than one
    flat.
    """
    from acquire.calibrate import open_calibration

    if "transfer" in step.finds and "linearity" in open_calibration(out).steps:
        return [name for name in step.finds if name != "transfer"]
    return list(step.finds)


def _evaluations(exposure: Exposure) -> dict[str, Callable[[Calibration], Finding]]:
    """Return the evaluation of a recording by each step, a function of the calibration so far."""
    from acquire.calibrate import columns, psf, target, veil
    from acquire.calibrate.transfer import transfer

    return {
        "dark": lambda _: columns.dark(exposure),
        "flat": lambda known: columns.flat(exposure, known),
        "transfer": lambda known: transfer([exposure], known),
        "orientation": lambda known: target.orientation(exposure, known),
        "align": lambda known: target.alignment(exposure, known),
        "psf": lambda known: psf.psf(exposure, known),
        "veil": lambda known: veil.veil_of_black(exposure, known),
    }
