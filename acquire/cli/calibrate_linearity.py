"""``acquire calibrate linearity``: a ramp of light out of the trigger's clock, on the running daemon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.calibrate.guide import LINEARITY, MOST_LINES, RAMP_LINES
from acquire.cli.calibrate_live import instrument, kept, record, tell_finding, wait_for_enter
from acquire.cli.control import SocketOption
from acquire.cli.output import JsonFlag, note, print_json, say

if TYPE_CHECKING:
    from acquire.calibrate.calibration import Finding
    from acquire.calibrate.exposure import Exposure


def linearity(
    out: Annotated[
        str,
        typer.Option("--out", metavar="CAL", help="The calibration: one that has a dark, which is added to."),
    ],
    recordings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RECORDING...", help="Recordings of a ramp, to be looked at again; absent: a new ramp."
        ),
    ] = None,
    directory: Annotated[
        Path, typer.Option(metavar="DIR", help="Directory of the recordings, which stay; made if absent.")
    ] = Path("calibration-recordings"),
    lines: Annotated[
        int, typer.Option(min=64, max=MOST_LINES, help="Number of lines of each recording.")
    ] = RAMP_LINES,
    yes: Annotated[bool, typer.Option("--yes", help="Ask nothing: everything is in place already.")] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """EMVA 1288's linearity error of both cameras, and the curve of one that bends.

    Records a ramp on the running daemon: the light is on for 1/16 to 15/16 of every sub-step, in ticks of the
    trigger, so that the ratios are exact whatever the lamp. The ramp tells DN per electron, read noise and
    full well, too. Reconstructions correct the curve. Needs the dark step, and comes before the flat. At
    Ctrl-C it ends with what it has. The instrument is left as it was: armed or not.

    Example: [bold]acquire calibrate linearity --out cal.zarr[/]
    """
    from acquire.calibrate.exposure import open_exposure

    if recordings:
        exposures = [open_exposure(each) for each in recordings]
    else:
        exposures = _ramp(out, directory, lines, socket, ask=not yes)
    found = _found(out, exposures)
    if json:
        print_json({"calibration": out, "steps": {each.step: _numbers(each) for each in found}})
        return
    for each in found:
        tell_finding(each)
        say()
    say(f"kept in  {out}")


def _ramp(out: str, directory: Path, lines: int, socket: Path | None, *, ask: bool) -> list[Exposure]:
    """Steady light, a sixteenth of it, and the levels between, until Ctrl-C."""
    from acquire.calibrate import open_calibration
    from acquire.calibrate.checks import offset_of
    from acquire.calibrate.linearity import PARTS, level_ticks, lit_ticks
    from acquire.cli.interrupts import first_interrupt_asks
    from acquire.cli.progress import Progress
    from acquire.daemon.messages import TriggerWindow

    offset = offset_of(open_calibration(out), "linearity")
    note(f"linearity: {LINEARITY.prepare}")
    if ask:
        wait_for_enter()

    with instrument(socket, directory) as daemon, first_interrupt_asks("ending with what there is") as asked:
        whole = record(daemon, "ramp", directory, lines, code="steady")
        ticks = lit_ticks(whole)[1]

        def level(lit: int) -> Exposure:
            window = TriggerWindow(open=0, close=lit)
            return record(daemon, "ramp", directory, lines, code="steady", window=window)

        dimmest = level(max(1, ticks // PARTS))
        levels = level_ticks(dimmest, offset)
        brightest = max(levels, default=0)
        note(
            f"{len(levels)} more recordings follow, with the light on for up to {brightest} of {ticks} ticks"
        )
        exposures = [whole, dimmest]
        with Progress("recording the ramp") as progress:
            for done, lit in enumerate(levels):
                progress.advance(done, len(levels))
                if asked.is_set():
                    break
                exposures.append(level(lit))
    return exposures


def _found(out: str, exposures: list[Exposure]) -> list[Finding]:
    from acquire.calibrate.linearity import linearity as bend
    from acquire.calibrate.transfer import transfer
    from acquire.cli.progress import stage_progress

    with stage_progress("reading the ramp") as advance:
        first = kept(out, exposures[0], lambda known: bend(exposures, known, progress=advance))
    return [first, kept(out, exposures[0], lambda known: transfer(exposures, known))]


def _numbers(found: Finding) -> dict[str, object]:
    values = {
        name: {"value": each.value.tolist(), "uncertainty": each.uncertainty.tolist()}
        for name, each in found.quantities.items()
    }
    return {"facts": found.facts, "warnings": found.warnings, **values}
