"""``acquire calibrate``: measure the instrument from recordings of known light, step by step."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.calibrate_all import calibrate_all
from acquire.cli.calibrate_delay import delay
from acquire.cli.calibrate_forget import forget
from acquire.cli.calibrate_linearity import linearity
from acquire.cli.calibrate_live import refuse_other
from acquire.cli.calibrate_sheet import sheet
from acquire.cli.completion import recordings
from acquire.cli.output import JsonFlag, print_facts, print_json, print_table, print_warning, say
from acquire.cli.places import calibration_place, given_path
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
        help="Recording: a directory NAME.zarr, or its URL, such as s3://bucket/NAME.zarr.",
    ),
]
OutOption = Annotated[
    str,
    typer.Option(
        "--out",
        metavar="CAL",
        help="Calibration to write, NAME.zarr. An existing one is extended with this step.",
        parser=calibration_place,
    ),
]
CoveredOption = Annotated[
    bool,
    typer.Option("--covered", help="The lens was covered during the recording, so that any code is valid."),
]
CHANGED = 1
"""Exit code of a check that finds the calibration out of date."""


def register(app: typer.Typer) -> None:
    group = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")
    for command in (
        dark,
        ambient,
        linearity,
        flat,
        transfer,
        orientation,
        align,
        psf,
        veil,
        delay,
        sheet,
        show,
        check,
        forget,
    ):
        group.command()(command)
    group.command("all")(calibrate_all)
    app.add_typer(
        group,
        name="calibrate",
        help="Measure the cameras, their alignment and optics from recordings of known light.",
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
    """Measure the offset and noise of every column, from lines recorded without the light.

    Record with the lens as in use and the exposure code 0 (code.kind = "constant", code.value = 0); the
    offset then includes the ambient light. Or cover the lens and give --covered. 1024 lines give offsets to
    0.1 DN. The black level must be above 0 by a few times the noise.

    Example: [bold]acquire calibrate dark dark.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import columns

    exposure = _exposure(recording, first_line, lines, begin, end, out)
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
    """Measure the ambient light, from lines recorded with the lens open and the exposure code 0.

    This step needs a dark that was recorded with --covered, since other darks already include the ambient
    light. 1024 lines are enough.

    Example: [bold]acquire calibrate ambient open.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import columns

    known, exposure = _known(out), _exposure(recording, first_line, lines, begin, end, out)
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
            help="The scene is not quite uniform: attribute smooth variation along the columns to the scene.",
        ),
    ] = False,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """Measure the gain of every column and the balance of the arms, from a white scene in steady light.

    Place a uniform white scene, larger than the field, before the lens, and record with the exposure code 1
    (code.value = 1) at 50 to 70 % of white. 1024 lines give gains to 0.05 %. The dark step must come first.

    Example: [bold]acquire calibrate flat flat.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import columns

    known, exposure = _known(out), _exposure(recording, first_line, lines, begin, end, out)
    with stage_progress(f"reading {recording}") as advance:
        found = columns.flat(exposure, known, smooth=smooth, progress=advance)
    _keep(out, found, json=json)


def transfer(
    recordings: Annotated[
        list[str],
        typer.Argument(metavar="RECORDING", help="Recordings of flats, at one or several light levels."),
    ],
    out: OutOption,
    json: JsonFlag = False,
) -> None:
    """Measure DN per electron, read noise and full well by the photon transfer method of EMVA 1288.

    Record flats as for the flat step. The full well needs several of them, from dim to saturated. 1024 lines
    give the DN per electron to 1 %, 4096 lines to 0.3 %. The dark step must come first.

    Example: [bold]acquire calibrate transfer flat-10.zarr flat-50.zarr flat-90.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import transfer as method

    known = _known(out)
    exposures = [_exposure(each, None, None, None, None, out) for each in recordings]
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
    """Find out how arm B's view is rotated or mirrored against arm A's, and whether the arms are swapped.

    Place a stationary target with sharp, irregular texture before the lens, and record with the usual
    pseudo-random code. 1024 lines are enough. If the lines do not decide between the eight views, the command
    reports it.

    Example: [bold]acquire calibrate orientation target.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import target

    known, exposure = _known_or_new(out, recording), _exposure(recording, first_line, lines, begin, end, out)
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
    """Measure how arm B's image lies on arm A's: shift, rotation, magnification, radial distortion.

    Place a stationary target before the lens that fills the field with sharp texture, dots or bars of 2 to 6
    fine pixels, and record with the usual pseudo-random code. 1024 lines give 0.02 fine pixels; 263 are too
    few. Align is best done after dark and flat. Behind a fibre each tile is aligned separately, along its
    fibre bands.

    Example: [bold]acquire calibrate align target.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import target

    known, exposure = _known_or_new(out, recording), _exposure(recording, first_line, lines, begin, end, out)
    with stage_progress("aligning the arms' images"):
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
    """Measure the width of each arm's optical blur from straight, sharp edges. This step is optional.

    Place the sheet that acquire calibrate sheet draws before the lens, or a square or a checkerboard, rotated
    by 3 to 20 degrees, stationary and in focus, with edges at least 30 fine pixels apart, and record with the
    usual pseudo-random code. 1024 lines give 0.05 fine pixels. The recording for align will do if it shows
    the sheet. If the lines do not determine the blur, the command reports it.
    Reconstructions then correct the blur.

    Example: [bold]acquire calibrate psf edges.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import psf as method

    known, exposure = _known_or_new(out, recording), _exposure(recording, first_line, lines, begin, end, out)
    with stage_progress("measuring the edges"):
        found = method.psf(exposure, known)
    _keep(out, found, json=json, new=True)


def veil(
    recording: RecordingArgument,
    out: OutOption,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """Measure the veil: the share of light that a lens spreads over the field. This step is optional.

    Place a target before the lens, stationary, with black parts of 30 by 30 fine pixels or more that send no
    light at all: holes in a white card before a dark room, or chrome on glass lit from behind. Printed black
    reflects 3 to 5 % and would be mistaken for a veil. Record with the usual pseudo-random code, after the
    step dark. 4096 lines give 0.1 % of the light. Reconstructions then correct the veil.

    Example: [bold]acquire calibrate veil black.zarr --out cal.zarr[/]
    """
    from acquire.calibrate import veil as method

    known, exposure = _known_or_new(out, recording), _exposure(recording, first_line, lines, begin, end, out)
    with stage_progress("measuring the veil"):
        found = method.veil(exposure, known)
    _keep(out, found, json=json, new=True)


def show(
    calibration: Annotated[
        str,
        typer.Argument(metavar="CAL", help="Calibration, or a recording that holds one.", parser=given_path),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Also write a page with plots into this new directory."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Show the contents of a calibration, their uncertainties, and how they were measured.

    Example: [bold]acquire calibrate show cal.zarr --out cal-page[/]
    """
    from acquire.calibrate import calibration_of
    from acquire.calibrate.words import known_facts
    from acquire.store import open_recording
    from acquire.store.layout import READABLE
    from acquire.store.opening import format_of

    try:
        is_recording = format_of(calibration) in READABLE
    except PlaceError:
        # `open_calibration` says what it lacks to be a calibration
        is_recording = False
    if is_recording:  # show the copy that it carries
        carried = calibration_of(open_recording(calibration))
        if carried is None:
            raise PlaceError(
                f"{calibration} holds no calibration", possible="a calibration, or a recording with one"
            )
        known = carried
    else:
        known = _known(calibration)
    if json:
        print_json(known.to_attrs())
    else:
        print_facts(known_facts(known))
    if out is not None:
        # Imported only for a page: matplotlib takes longer than everything else here.
        from acquire.cli.places import new_directory
        from acquire.evaluate.calibration_page import write_page

        with new_directory(out):
            page = write_page(known, out, calibration, known_facts(known))
        if not json:
            say(f"page  {page}")


def check(
    calibration: Annotated[
        str, typer.Argument(metavar="CAL", help="Calibration NAME.zarr.", parser=given_path)
    ],
    recording: RecordingArgument,
    covered: CoveredOption = False,
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    json: JsonFlag = False,
) -> None:
    """Check whether a calibration is still valid, using a new recording of dark lines, a flat or a target.

    The exit code is 1 if something has changed by more than reconstructions tolerate.

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
                ("quantity", "change", "unit", "uncertainty", "verdict"), [tuple(r.values()) for r in rows]
            )
        else:
            say("nothing could be compared")
        for doubt in found.doubts:
            print_warning(doubt)
    if not found.holds:
        # Without a message: the table, or the JSON, says what has changed.
        raise typer.Exit(CHANGED)


def _exposure(
    recording: str,
    first_line: int | None,
    lines: int | None,
    begin: str | None,
    end: str | None,
    out: str | None = None,
) -> Exposure:
    """Open the lines of a recording. Raises UsageError for another instrument than the calibration's."""
    from acquire.calibrate.exposure import open_exposure
    from acquire.store import open_recording

    if begin is not None or end is not None:
        # Numbers are left to `open_exposure`, which knows what a calibration needs.
        first_line, lines = lines_between(open_recording(recording), first_line, lines, begin, end)
    found = open_exposure(recording, first_line, lines)
    if out is not None:
        refuse_other(out, [found])
    return found


def _known(place: str) -> Calibration:
    from acquire.calibrate import open_calibration

    return open_calibration(place)


def _known_or_new(place: str, recording: str) -> Calibration:
    """Return the calibration at a place, or an empty one for the recording's instrument."""
    from acquire.calibrate import Calibration
    from acquire.calibrate.exposure import instrument_of
    from acquire.store import open_recording

    # These steps need no earlier ones, and may be a calibration's first.
    if _exists(place):
        return _known(place)
    return Calibration(instrument_of(open_recording(recording)))


def _exists(place: str) -> bool:
    from acquire.store.source import source_of

    return source_of(place).exists()


def _keep(place: str, found: Finding, *, json: bool, new: bool = False) -> None:
    """Add a finding to the calibration at a place, and print it."""
    from acquire.calibrate import Calibration
    from acquire.calibrate.file import change_calibration

    # Shown all the same: the figures say by how little the views differ. Saved, it would count as known.
    if found.step == "orientation" and found.orientation is None:
        _print_finding(found, None, json=json)
        raise UsageError(
            f"the orientation cannot be determined from {found.facts['recording']}",
            hint="a stationary target with sharp, irregular texture, or more lines",
        )
    # Only steps that need no earlier one may begin a calibration.
    begun = Calibration(found.instrument) if new else None
    change_calibration(place, lambda known: known.with_step(found), new=begun)
    _print_finding(found, place, json=json)


def _print_finding(found: Finding, place: str | None, *, json: bool) -> None:
    from acquire.calibrate.words import found_facts

    facts = found_facts(found)
    if json:
        print_json({"calibration": place, "found": facts, "facts": found.facts, "warnings": found.warnings})
        return
    print_facts(facts)
    if place is not None:
        print_facts({"saved in": place})
    for text in found.warnings:
        print_warning(text)
