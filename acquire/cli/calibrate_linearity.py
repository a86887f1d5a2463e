"""``acquire calibrate linearity``: a light ramp timed by the trigger's clock, on the running daemon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.calibrate.guide import LINEARITY, MOST_LINES, RAMP_LINES
from acquire.cli.calibrate_live import (
    print_finding,
    record,
    refuse_other,
    save_finding,
    series,
)
from acquire.cli.control import SocketOption
from acquire.cli.output import JsonFlag, note, print_json, say
from acquire.cli.places import calibration_place

if TYPE_CHECKING:
    from acquire.calibrate.exposure import Exposure


def linearity(
    out: Annotated[
        str,
        typer.Option(
            "--out",
            metavar="CAL",
            help="Calibration to extend, NAME.zarr. It must have a dark.",
            parser=calibration_place,
        ),
    ],
    recordings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RECORDING",
            help="Evaluate these recordings of an earlier ramp. Default: record a new ramp.",
        ),
    ] = None,
    directory: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Directory for the recordings, which are kept. Created if needed."),
    ] = Path("calibration-recordings"),
    lines: Annotated[
        int, typer.Option(min=64, max=MOST_LINES, help="Number of lines of each recording.")
    ] = RAMP_LINES,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for Enter: the scene is in place already.")
    ] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Measure the linearity error of both cameras as in EMVA 1288, and the curve of a nonlinear one.

    The command records a ramp on the running daemon: the light is on for 1/16 to 15/16 of every sub-step, in
    ticks of the trigger, so that the ratios are exact whatever the lamp. The ramp also gives DN per electron,
    read noise and full well. Reconstructions correct the curve. The dark step must come first, and the flat
    comes afterwards. Ctrl-C ends the ramp early and evaluates the recordings made so far. Afterwards the
    instrument is armed or idle as it was before.

    Example: [bold]acquire calibrate linearity --out cal.zarr[/]
    """
    from acquire.calibrate.exposure import open_exposure
    from acquire.calibrate.linearity import linearity as evaluate
    from acquire.calibrate.transfer import transfer
    from acquire.cli.progress import stage_progress

    if recordings:
        exposures = [open_exposure(each) for each in recordings]
        refuse_other(out, exposures)
    else:
        exposures = _ramp(out, directory, lines, socket, ask=not yes)
    with stage_progress("evaluating the ramp") as advance:
        curve = save_finding(
            out,
            exposures,
            lambda known: evaluate(exposures, known, progress=advance),
            ["linearity"],
            # It was there when the ramp was recorded: that it is gone is said, not that there is no dark.
            first=bool(recordings),
        )
    # Only now: it straightens the levels by the curve that has just been saved.
    gain = save_finding(out, exposures, lambda known: transfer(exposures, known), ["linearity"], first=False)
    if json:
        steps = {}
        for found in (curve, gain):
            values = {
                name: {"value": each.value.tolist(), "uncertainty": each.uncertainty.tolist()}
                for name, each in found.quantities.items()
            }
            steps[found.step] = {"facts": found.facts, "warnings": found.warnings, **values}
        print_json({"calibration": out, "steps": steps})
        return
    for found in (curve, gain):
        print_finding(found)
        say()
    say(f"saved in  {out}")


def _ramp(out: str, directory: Path, lines: int, socket: Path | None, *, ask: bool) -> list[Exposure]:
    """Record steady light, a sixteenth of it, and the levels between, until Ctrl-C."""
    from acquire.calibrate import open_calibration
    from acquire.calibrate.checks import offset_of
    from acquire.calibrate.linearity import PARTS, level_ticks, lit_ticks
    from acquire.cli.progress import ProgressDisplay
    from acquire.daemon.messages import TriggerWindow

    # Before the recordings, not after: without a dark they could not be evaluated.
    offset = offset_of(open_calibration(out), "linearity")
    with series(socket, directory, out, f"linearity: {LINEARITY.prepare}", ask=ask) as (daemon, stopped):
        whole = record(daemon, "ramp", directory, lines, out, code="steady")
        ticks = lit_ticks(whole)[1]

        def level(lit: int) -> Exposure:
            window = TriggerWindow(open=0, close=lit)
            return record(daemon, "ramp", directory, lines, out, code="steady", window=window)

        # First the dimmest: the levels in between follow from it.
        dimmest = level(max(1, ticks // PARTS))
        levels = level_ticks(dimmest, offset)
        brightest = max(levels, default=0)
        note(
            f"{len(levels)} more recordings follow, with the light on for up to {brightest} of {ticks} ticks"
        )
        exposures = [whole, dimmest]
        with ProgressDisplay("recording the ramp") as progress:
            for done, lit in enumerate(levels):
                progress.advance(done, len(levels))
                if stopped.is_set():
                    break
                exposures.append(level(lit))
    return exposures
