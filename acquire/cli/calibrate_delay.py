"""``acquire calibrate delay``: light against line start and sub-step, swept by the trigger."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.calibrate.guide import DELAY, MOST_LINES
from acquire.cli.calibrate_live import instrument, kept, record, tell_finding, wait_for_enter
from acquire.cli.control import SocketOption
from acquire.cli.output import JsonFlag, note, print_json
from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.calibrate.calibration import Finding
    from acquire.calibrate.exposure import Exposure


def delay(
    out: Annotated[
        str, typer.Option("--out", metavar="CAL", help="The calibration: new, or one that is added to.")
    ],
    recordings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RECORDING...", help="Recordings of a sweep, to be looked at again; absent: a new sweep."
        ),
    ] = None,
    directory: Annotated[
        Path, typer.Option(metavar="DIR", help="Directory of the recordings, which stay; made if absent.")
    ] = Path("calibration-recordings"),
    lines: Annotated[
        int | None,
        typer.Option(
            min=DELAY.least_lines,
            max=MOST_LINES,
            help="Number of lines of each recording; absent: as many as half a tick takes.",
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Ask nothing: everything is in place already.")] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """How late the light is for either camera, to a tick of the trigger, and what to put into the rig file.

    Sweeps the trigger's delays on the running daemon: one recording that shows where light and charge are,
    and six around it. At Ctrl-C it ends with what it has. The instrument is left as it was: armed or not.
    Noise is what limits it: bright light, just below saturation, is best.

    Example: [bold]acquire calibrate delay --out cal.zarr[/]
    """
    from acquire.calibrate.exposure import open_exposure

    if recordings:
        exposures, whole = [open_exposure(each) for each in recordings], True
    else:
        exposures, whole = _swept(directory, lines, socket, ask=not yes)
    found = _found(out, exposures, whole=whole)
    if json:
        late = found.quantities["light_late_ticks"]
        facts = {"calibration": out, "facts": found.facts, "warnings": found.warnings}
        ticks = {"light_late_ticks": late.value.tolist(), "uncertainty_ticks": late.uncertainty.tolist()}
        print_json(facts | ticks)
        return
    tell_finding(found, {"kept in": out})


def _swept(
    directory: Path, lines: int | None, socket: Path | None, *, ask: bool
) -> tuple[list[Exposure], bool]:
    """One recording to see where to look, and one for each setting around that, until Ctrl-C; whether it is
    the whole sweep.
    """
    from acquire.calibrate import delay_sweep as sweep
    from acquire.cli.interrupts import first_interrupt_asks
    from acquire.cli.progress import Progress
    from acquire.daemon.messages import TriggerDelays

    note(f"delay: {DELAY.prepare}")
    if ask:
        wait_for_enter()
    with instrument(socket, directory) as daemon, first_interrupt_asks("ending with what there is") as asked:
        first = record(daemon, "delay", directory, sweep.FIRST_LINES)
        setting, point = sweep.setting_of(first), sweep.point_of(first)
        late = sweep.first_sight(point, setting.substep_ticks)
        lines = lines or sweep.lines_for(point, first.lines, setting.substep_ticks)
        settings = setting.sweep(late)
        about = " and ".join(f"{each:.0f}" for each in late)
        note(f"the light is about {about} ticks late; {len(settings)} recordings of {lines} lines follow")
        exposures = [first]
        with Progress("sweeping the delays") as progress:
            for done, each in enumerate(settings):
                progress.advance(done, len(settings))
                if asked.is_set():
                    break
                delays = TriggerDelays(light_lead=each.light_lead_ticks, a=each.a_ticks, b=each.b_ticks)
                exposures.append(record(daemon, "delay", directory, lines, delays=delays))
    return exposures, len(exposures) == 1 + len(settings)


def _found(out: str, exposures: list[Exposure], *, whole: bool) -> Finding:
    """A part of a sweep does not take the place of what is known better."""
    from acquire.calibrate.delay_sweep import delay as look
    from acquire.cli.progress import stage_progress

    with stage_progress("looking beyond the lines' sub-steps") as advance:
        found = look(exposures, progress=advance)
    if not whole and (known := _known_ticks(out)) is not None:
        doubt = float(found.quantities["light_late_ticks"].uncertainty.max())
        if known < doubt:
            raise UsageError(
                f"this part of a sweep is sure to {doubt:.1f} ticks only, and {out} knows it to {known:.1f}",
                hint="the whole sweep; what was known stays",
            )
    return kept(out, exposures[0], lambda _: found)


def _known_ticks(out: str) -> float | None:
    """How surely the calibration at a place knows the delays already; None where it does not."""
    from acquire.calibrate import open_calibration
    from acquire.store.source import source_of

    if not source_of(out).exists():
        return None
    late = open_calibration(out).quantities.get("light_late_ticks")
    return None if late is None else float(late.uncertainty.max())
