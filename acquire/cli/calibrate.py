"""``acquire calibrate``: what the instrument is, measured from recordings of known light, step by step."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.calibrate_all import calibrate_all
from acquire.cli.calibrate_delay import delay
from acquire.cli.calibrate_linearity import linearity
from acquire.cli.completion import recordings
from acquire.cli.output import JsonFlag, print_facts, print_json, print_table, print_warning, say
from acquire.cli.progress import stage_progress
from acquire.cli.stretch import FirstLineOption, FromOption, LinesOption, ToOption, lines_between
from acquire.errors import PlaceError, UsageError

if TYPE_CHECKING:
    from acquire.calibrate.calibration import Calibration, Finding
    from acquire.calibrate.exposure import Exposure

RecordingArgument = Annotated[
    str,
    typer.Argument(
        metavar="RECORDING",
        autocompletion=recordings,
        help="A directory NAME.zarr, or its URL: s3://bucket/NAME.zarr.",
    ),
]
OutOption = Annotated[
    str,
    typer.Option("--out", metavar="CAL", help="The calibration: a new NAME.zarr, or one that is added to."),
]
CoveredOption = Annotated[
    bool, typer.Option("--covered", help="The lens is covered: the code does not matter.")
]
CHANGED = 1
"""Exit code of a check that finds the calibration no longer true."""


def register(app: typer.Typer) -> None:
    group = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")
    for command in (dark, ambient, linearity, flat, transfer, orientation, align, psf, delay, show, check):
        group.command()(command)
    group.command("all")(calibrate_all)
    app.add_typer(
        group,
        name="calibrate",
        help="Measure offsets, gains, noise, orientation, alignment and blur from recordings of known light.",
        rich_help_panel="Rig",
    )


def dark(
    recording: RecordingArgument,
    out: OutOption,
    covered: CoveredOption = False,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """Offset and noise of every column, from lines without the light.

    Record with the lens as in use and the light's code 0 (code.kind = "constant", code.value = 0): the offset
    then holds the ambient light, too. Or cover the lens and say --covered. 1024 lines give offsets to 0.1 DN;
    the black level must be some noises above 0.

    Example: [bold]acquire calibrate dark dark.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import columns

    exposure = _exposure(recording, first_line, lines, begin, end)
    with stage_progress(f"reading {recording}") as advance:
        found = columns.dark(exposure, covered=covered, progress=advance)
    _keep(out, found, json=json, new=True)


def ambient(
    recording: RecordingArgument,
    out: OutOption,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """Light that no code switches, from lines with the lens open and the light's code 0.

    Only after a dark that was --covered: other darks hold the ambient light already. 1024 lines are enough.

    Example: [bold]acquire calibrate ambient open.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import columns

    known, exposure = _known(out), _exposure(recording, first_line, lines, begin, end)
    with stage_progress(f"reading {recording}") as advance:
        found = columns.ambient(exposure, known, progress=advance)
    _keep(out, found, json=json)


def flat(
    recording: RecordingArgument,
    out: OutOption,
    smooth: Annotated[
        bool,
        typer.Option(
            "--smooth",
            help="The scene is not quite uniform: what varies smoothly along the columns is the scene's.",
        ),
    ] = False,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """Gain of every column and the arms' balance, from a white scene under steady light.

    Put a uniform white scene in, larger than the field, and record with the light's code 1 at 50 to 70 % of
    white. 1024 lines give gains to 0.05 %. Needs the dark step.

    Example: [bold]acquire calibrate flat flat.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import columns

    known, exposure = _known(out), _exposure(recording, first_line, lines, begin, end)
    with stage_progress(f"reading {recording}") as advance:
        found = columns.flat(exposure, known, smooth=smooth, progress=advance)
    _keep(out, found, json=json)


def transfer(
    recordings: Annotated[
        list[str], typer.Argument(metavar="RECORDING...", help="Flats, at one level of light or several.")
    ],
    out: OutOption,
    json: JsonFlag = False,
) -> None:
    """DN per electron and read noise, and the full well where the light reaches it: EMVA 1288's transfer.

    Record flats as for the flat step; several, from dim to saturated, show the full well. 1024 lines give the
    DN per electron to 1 %, 4096 to 0.3 %. Needs the dark step.

    Example: [bold]acquire calibrate transfer flat-10.zarr flat-50.zarr flat-90.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import transfer as method

    known = _known(out)
    exposures = [_exposure(each, None, None, None, None) for each in recordings]
    with stage_progress("reading the flats") as advance:
        found = method.transfer(exposures, known, progress=advance)
    _keep(out, found, json=json)


def orientation(
    recording: RecordingArgument,
    out: OutOption,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """Which of eight views of the scene arm B has: turned how, mirrored or not, arms swapped or not.

    Put in a target at rest with sharp, irregular texture and record with the usual pseudo-random code.
    1024 lines tell. "Cannot tell" is among the answers.

    Example: [bold]acquire calibrate orientation target.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import target

    known, exposure = _known_or_new(out, recording), _exposure(recording, first_line, lines, begin, end)
    with stage_progress("comparing the arms' images"):
        found = target.orientation(exposure, known)
    _keep(out, found, json=json, new=True)


def align(
    recording: RecordingArgument,
    out: OutOption,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """Where arm B's image lies on arm A's: shift, turn and magnification.

    Put in a target at rest with sharp texture all over the field, dots or bars of 2 to 6 fine pixels, and
    record with the usual pseudo-random code. 1024 lines give 0.02 fine pixels; 263 are too few. Best after
    dark and flat. Behind a fibre each tile is aligned by itself, as its bands lie.

    Example: [bold]acquire calibrate align target.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import target

    known, exposure = _known_or_new(out, recording), _exposure(recording, first_line, lines, begin, end)
    with stage_progress("laying the arms' images on each other"):
        behind = exposure.recording.fibre is not None
        found = (target.tile_alignments if behind else target.alignment)(exposure, known)
    _keep(out, found, json=json, new=True)


def psf(
    recording: RecordingArgument,
    out: OutOption,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """How wide the optics blur each arm's image, from straight sharp edges; where it is wanted.

    Put in a square or a checkerboard, turned by 3 to 20 degrees, its edges 30 fine pixels or more from one
    another, at rest and in focus, and record with the usual pseudo-random code. 1024 lines give 0.05 fine
    pixels. "Cannot tell" is among the answers. A reconstruction then sharpens by as much.

    Example: [bold]acquire calibrate psf edges.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import psf as method

    known, exposure = _known_or_new(out, recording), _exposure(recording, first_line, lines, begin, end)
    with stage_progress("looking at edges"):
        found = method.psf(exposure, known)
    _keep(out, found, json=json, new=True)


def show(
    calibration: Annotated[
        str, typer.Argument(metavar="CAL", help="A calibration, or a recording that carries one.")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="New directory for a page with plots.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """What a calibration holds, how sure it is, and how it was found; as a page with plots, too.

    Example: [bold]acquire calibrate show cal.zarr --out cal-page[/]
    """
    from acquire.calibrate.words import known_facts

    known = _any(calibration)
    if json:
        print_json(known.to_attrs())
    else:
        print_facts(known_facts(known))
    if out is not None:
        from acquire.cli.places import new_directory
        from acquire.evaluate.calibration_page import write_page

        with new_directory(out):
            page = write_page(known, out, calibration, known_facts(known))
        if not json:
            say(f"page  {page}")


def check(
    calibration: Annotated[str, typer.Argument(metavar="CAL", help="A calibration: NAME.zarr.")],
    recording: RecordingArgument,
    covered: CoveredOption = False,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """Is a calibration still true? A new recording of dark lines, a flat or a target is compared with it.

    Ends with 1 where something has changed by more than a reconstruction can take.

    Example: [bold]acquire calibrate check cal.zarr target-today.zarr[/]
    """
    from acquire.calibrate.check import check as compare
    from acquire.calibrate.words import compared_rows

    known, exposure = _known(calibration), _exposure(recording, first_line, lines, begin, end)
    with stage_progress("comparing"):
        found = compare(exposure, known, covered=covered)
    rows = compared_rows(found)
    if json:
        print_json({"holds": found.holds, "compared": rows, "doubts": found.doubts})
    else:
        if rows:
            print_table(
                ("quantity", "changed by", "unit", "sure to", "so"), [tuple(r.values()) for r in rows]
            )
        else:
            say("nothing could be compared")
        for doubt in found.doubts:
            print_warning(doubt)
    if not found.holds:
        raise typer.Exit(CHANGED)


def _exposure(
    recording: str, first_line: int | None, lines: int | None, begin: str | None, end: str | None
) -> Exposure:
    from acquire.calibrate.exposure import open_exposure
    from acquire.store import open_recording

    if begin is not None or end is not None:
        first_line, lines = lines_between(open_recording(recording), first_line, lines, begin, end)
    return open_exposure(recording, first_line, lines)


def _known(place: str) -> Calibration:
    from acquire.calibrate import open_calibration

    return open_calibration(place)


def _known_or_new(place: str, recording: str) -> Calibration:
    """The calibration at a place, or an empty one of the recording's instrument."""
    from acquire.calibrate import Calibration
    from acquire.calibrate.exposure import instrument_of
    from acquire.store import open_recording

    if _there(place):
        return _known(place)
    return Calibration(instrument_of(open_recording(recording)))


def _any(place: str) -> Calibration:
    """A calibration, or the copy that a recording carries."""
    from acquire.calibrate import calibration_of
    from acquire.store import open_recording
    from acquire.store.layout import READABLE
    from acquire.store.opening import format_of

    if format_of(place) not in READABLE:
        return _known(place)
    found = calibration_of(open_recording(place))
    if found is None:
        raise PlaceError(f"{place} carries no calibration", possible="a calibration, or a recording with one")
    return found


def _there(place: str) -> bool:
    from acquire.store.source import source_of

    return source_of(place).exists()


def _keep(place: str, found: Finding, *, json: bool, new: bool = False) -> None:
    """Add what was found to the calibration at a place, and say it."""
    from acquire.calibrate import Calibration, save_calibration

    known = Calibration(found.instrument) if new and not _there(place) else _known(place)
    if found.step == "orientation" and found.orientation is None:
        _tell(found, None, json=json)
        raise UsageError(
            f"the orientation cannot be told from {found.facts['recording']}",
            hint="a target with sharp, irregular texture, at rest; more lines",
        )
    save_calibration(place, known.with_step(found))
    _tell(found, place, json=json)


def _tell(found: Finding, place: str | None, *, json: bool) -> None:
    from acquire.calibrate.words import found_facts

    facts = found_facts(found)
    if json:
        print_json({"calibration": place, "found": facts, "facts": found.facts, "warnings": found.warnings})
        return
    print_facts(facts)
    if place is not None:
        print_facts({"kept in": place})
    for text in found.warnings:
        print_warning(text)
