"""``acquire calibrate delay``: measure the delay of the light against the lines, by sweeping the trigger."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.calibrate.guide import DELAY, MOST_LINES
from acquire.cli.calibrate_live import (
    print_finding,
    record,
    recordings_kept,
    refuse_other,
    save_finding,
    series,
)
from acquire.cli.control import SocketOption
from acquire.cli.output import JsonFlag, note, print_json
from acquire.cli.places import calibration_place
from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.calibrate.calibration import Finding
    from acquire.calibrate.exposure import Exposure


def delay(
    out: Annotated[
        str,
        typer.Option(
            "--out",
            metavar="CAL",
            help="Calibration to write, NAME.zarr. An existing one is extended.",
            parser=calibration_place,
        ),
    ],
    recordings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RECORDING",
            help="Evaluate these recordings of an earlier sweep. Default: record a new sweep.",
        ),
    ] = None,
    directory: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Directory for the recordings, which are kept. Created if needed."),
    ] = Path("calibration-recordings"),
    lines: Annotated[
        int | None,
        typer.Option(
            min=DELAY.least_lines,
            max=MOST_LINES,
            help="Number of lines per recording. Default: enough for an uncertainty of half a tick.",
        ),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for Enter: the scene is in place already.")
    ] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Measure the delay of the light for each camera, to one tick of the trigger.

    The result includes the keys for the rig file. The command sweeps the trigger's delays on the running
    daemon: a first recording gives the rough delay, and six more follow around it. Ctrl-C ends the sweep
    early and evaluates the recordings made so far. Afterwards the instrument is armed or idle as it was
    before. Noise limits the result, so bright light just below saturation is best.

    Example: [bold]acquire calibrate delay --out cal.zarr[/]
    """
    from acquire.calibrate.exposure import open_exposure

    if recordings:
        # Whole, whatever it lacks: these recordings are what the user wants to be evaluated.
        exposures, whole = [open_exposure(each) for each in recordings], True
        refuse_other(out, exposures)
    else:
        exposures, whole = _swept(out, directory, lines, socket, ask=not yes)
    found = _found(out, exposures, whole=whole)
    if json:
        late = found.quantities["light_late_ticks"]
        facts = {"calibration": out, "facts": found.facts, "warnings": found.warnings}
        ticks = {"light_late_ticks": late.value.tolist(), "uncertainty_ticks": late.uncertainty.tolist()}
        print_json(facts | ticks)
        return
    print_finding(found, {"saved in": out})


def _swept(
    out: str, directory: Path, lines: int | None, socket: Path | None, *, ask: bool
) -> tuple[list[Exposure], bool]:
    """Record the sweep until Ctrl-C; return its exposures, and whether the sweep is complete."""
    from acquire.calibrate import delay_sweep as sweep
    from acquire.cli.progress import ProgressDisplay
    from acquire.daemon.messages import TriggerDelays

    with series(socket, directory, out, f"delay: {DELAY.prepare}", ask=ask) as (daemon, stopped):
        # the first recording gives the rough delay, around which the sweep is laid
        first = record(daemon, "delay", directory, sweep.FIRST_LINES, out)
        setting, point = sweep.setting_of(first), sweep.point_of(first)
        late = sweep.first_sight(point, setting.substep_ticks)
        lines = lines or sweep.lines_for(point, first.lines, setting.substep_ticks)
        settings = setting.sweep(late)
        about = " and ".join(f"{each:.0f}" for each in late)
        note(f"the light is about {about} ticks late; {len(settings)} recordings of {lines} lines follow")
        exposures = [first]
        with ProgressDisplay("sweeping the delays") as progress:
            for done, each in enumerate(settings):
                progress.advance(done, len(settings))
                if stopped.is_set():
                    break
                delays = TriggerDelays(light_lead=each.light_lead_ticks, a=each.a_ticks, b=each.b_ticks)
                exposures.append(record(daemon, "delay", directory, lines, out, delays=delays))
    return exposures, len(exposures) == 1 + len(settings)


def _found(out: str, exposures: list[Exposure], *, whole: bool) -> Finding:
    """Evaluate and save a sweep. An incomplete one does not replace a result with a smaller uncertainty."""
    from acquire.calibrate import open_calibration
    from acquire.calibrate.delay_sweep import delay as evaluate
    from acquire.cli.progress import stage_progress
    from acquire.store.source import source_of

    with stage_progress("evaluating the sweep") as advance:
        found = evaluate(exposures, progress=advance)
    if not whole and source_of(out).exists():
        with recordings_kept(out, exposures, ["delay"]):
            known = open_calibration(out).quantities.get("light_late_ticks")
        ticks = float(found.quantities["light_late_ticks"].uncertainty.max())
        # A sweep that Ctrl-C cut short must not spoil what a whole one has found.
        if known is not None and known.uncertainty.max() < ticks:
            raise UsageError(
                f"this part of a sweep has an uncertainty of {ticks:.1f} ticks, more than the "
                f"{known.uncertainty.max():.2g} in {out}",
                hint="the whole sweep; the earlier result is kept",
            )
    # Evaluated already, since its uncertainty decided whether it is saved.
    return save_finding(out, exposures, lambda _: found, ["delay"])
