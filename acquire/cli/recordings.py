"""``acquire ls | info | cut | verify | recover | hold | upload``: recordings, here or at URLs; no daemon."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.completion import recordings
from acquire.cli.output import JsonFlag, print_facts, print_json, print_table, quantity, say
from acquire.cli.places import local_path
from acquire.cli.progress import stage_progress
from acquire.cli.stretch import FirstLineOption, FromOption, LinesOption, ToOption, lines_between
from acquire.cli.tiles import TileOption, tile_of
from acquire.errors import AcquireError, DataError, UsageError
from acquire.text import shortened

if TYPE_CHECKING:
    from collections.abc import Iterable

    from acquire.lines import Segment
    from acquire.store import Mirrored, Outline

PlaceArgument = Annotated[
    str,
    typer.Argument(
        metavar="RECORDING",
        autocompletion=recordings,
        help="A directory NAME.zarr, or its URL: s3://bucket/NAME.zarr.",
    ),
]

RecordingArgument = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING", autocompletion=recordings, help="A directory NAME.zarr.", parser=local_path
    ),
]

LISTED = 20
"""Damaged stretches that are printed; --json has all of them."""

MOST_NS = 2**62
"""After 1970: what a calendar can name."""

CELL_CHARACTERS = 72
"""What a table shows of an error; --json has all of it."""


def register(app: typer.Typer) -> None:
    app.command("ls", rich_help_panel="Recordings")(list_recordings)
    for command in (info, verify, recover, hold, upload, cut):
        app.command(rich_help_panel="Recordings")(command)


def list_recordings(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Directory that is searched.")] = Path(),
    json: JsonFlag = False,
) -> None:
    """List the recordings of a directory; damaged ones are listed as such, videos are not.

    Example: [bold]acquire ls /data[/]
    """
    from acquire.store.refusals import refused

    with refused(directory, "listed", "a directory that holds recordings; `acquire info` describes one"):
        named = sorted(path for path in directory.iterdir() if path.name.endswith(".zarr"))
    found = [_summary(path) for path in named if _may_be_one(path)]
    if json:
        print_json(found)
    elif not found:
        say(f"no recordings in {directory}")
    else:
        print_table(("recording", "lines", "duration", "size", "state", "started (UTC)"), map(_row, found))


def info(recording: PlaceArgument, json: JsonFlag = False) -> None:
    """What a recording holds: geometry, code, clock, losses, how it ended.

    Example: [bold]acquire info run.zarr[/]
    """
    from acquire.store import open_outline, suspect_lines

    opened = open_outline(recording)
    suspect = [found.to_dict() for found in suspect_lines(opened)]
    facts = opened.info() | {"damage": _damage(opened), "suspect": suspect}
    if json:
        gaps = [
            {"arm": gap.arm, "first_line": gap.first_line, "count": gap.count, "cause": gap.cause}
            for gap in opened.gaps
        ]
        print_json({**facts, "gap_list": gaps})
        return
    print_facts(_readable(facts))
    if opened.gaps:
        say()
        rows = [(gap.arm, gap.first_line, gap.count, gap.cause) for gap in opened.gaps]
        print_table(("arm", "first lost line", "lines", "cause"), rows)


def verify(recording: PlaceArgument, json: JsonFlag = False) -> None:
    """Read all of a recording: is every line there and intact, do numbering, gaps and ledger agree?

    Ends with 6 where something is lost or damaged, and says which lines.

    Example: [bold]acquire verify run.zarr[/]
    """
    from acquire.store import verify as verify_recording

    with stage_progress(f"verifying {recording}") as progress:
        found = verify_recording(recording, progress)
    if json:
        print_json(found.to_dict())
    else:
        verdict = "intact" if found.intact else "DAMAGED"
        size = quantity(found.bytes, "B")
        say(f"{found.path}: {verdict}; {found.state}, {found.lines} lines, {size}")
        _print_list("not intact on disk", map(str, found.damage))
        _print_list("contradictions", found.contradictions)
        _print_list("note", found.notes)
    if not found.intact:
        raise typer.Exit(DataError.exit_code)


def recover(recording: RecordingArgument, json: JsonFlag = False) -> None:
    """Seal a recording whose writer was killed or lost its power; nothing that was committed is cut off.

    Lines that are not intact on disk are flagged as missing and listed. A second time changes nothing.

    Example: [bold]acquire recover run.zarr[/]
    """
    from acquire.store import recover as recover_recording

    with stage_progress(f"recovering {recording}") as progress:
        done = recover_recording(recording, progress=progress)
    if json:
        print_json(done.to_dict())
        return
    added = done.lines - done.lines_before
    found = f"; {added} lines were on disk that no commit listed" if added else ""
    what = f"recovered and sealed{found}" if done.changed else "nothing to recover"
    say(f"{done.path}: {done.lines} lines, {what}")
    if done.root_rebuilt:
        say("  its root zarr.json was lost, and is written anew from the copy of its attributes")
    if done.not_listed:
        say(f"  it is not listed in the first recording of its run: {done.not_listed}")
    if done.indices_mended:
        say(f"  {done.indices_mended} indices of files were mended")
    _print_list("lost, flagged as missing", map(str, done.damage))


def hold(
    recording: RecordingArgument,
    first_line: FirstLineOption = None,
    lines: Annotated[
        int | None, typer.Option(help="Number of lines, also of lines that are still to come.")
    ] = None,
    begin: FromOption = None,
    end: ToOption = None,
    why: Annotated[str, typer.Option(metavar="TEXT", help="Reason, which `acquire info` shows.")] = "",
    json: JsonFlag = False,
) -> None:
    """Keep lines of an endless recording, with what reconstruction needs around them, from being dropped.

    Ends with 6 where some of them are gone already; the others are held.

    Example: [bold]acquire hold run.zarr --first-line 2000 --lines 5000 --why flash[/]
    """
    from acquire.store import hold as hold_lines
    from acquire.store import open_recording

    first, count = lines_between(open_recording(recording), first_line, lines, begin, end, to_come=True)
    if first is None or count is None:
        raise UsageError(
            "hold: begin and end of the stretch are missing",
            possible="--first-line and --lines, --from and --to, or --from and --lines",
        )
    held = hold_lines(recording, first, count, why)
    if json:
        print_json({"path": str(recording), "first_line": held.first_line, "lines": held.count, "why": why})
    else:
        say(f"{recording}: lines {first} to {first + count - 1} are held")


def upload(
    recording: RecordingArgument,
    url: Annotated[
        str, typer.Argument(help="Copy's address: s3://bucket/NAME.zarr, or whatever fsspec reaches.")
    ],
    follow: Annotated[
        bool, typer.Option("--follow", help="Keep copying until the recording is sealed.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Copy a recording to a remote store, also while it grows; one that was interrupted goes on where it was.

    Lines that are not copied yet are held: retention of an endless recording leaves them alone.

    Example: [bold]acquire upload run.zarr s3://bucket/run.zarr --follow[/]
    """
    from acquire.store import mirror
    from acquire.store.remote import be_patient

    be_patient()

    def report(done: Mirrored) -> None:
        if not json:
            say(f"{url}: {done.lines} lines, {quantity(done.bytes, 'B')} copied", err=True)

    with stage_progress(f"copying {recording.name}") as progress:
        done = mirror(recording, url, follow=follow, report=report, progress=progress)
    if json:
        print_json(done.to_dict())
    else:
        state = "sealed" if done.sealed else "still growing"
        say(f"{url}: {done.lines} lines, {state}; {quantity(done.bytes, 'B')} copied now")


def cut(
    recording: PlaceArgument,
    out: Annotated[Path, typer.Option(metavar="FILE.npz", help="New file.")],
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    merge: Annotated[
        int,
        typer.Option(min=1, help="Lines and columns of a sensor without intra-line steps that are added up."),
    ] = 1,
    tile: TileOption = None,
    json: JsonFlag = False,
) -> None:
    """Write a stretch of both arms to an npz file: lines, mask, code, time_ns, stages, substeps and scales.

    --merge 3 makes of 192 stages that are triggered at every sub-step 64 stages with 3 intra-line steps.

    Example: [bold]acquire cut run.zarr --first-line 2000 --lines 256 --out segment.npz[/], or
    [bold]acquire cut run.zarr --from 52ms --to 60ms --out segment.npz[/]
    """
    from acquire.lines import merged
    from acquire.store import open_recording
    from acquire.store.files import check_new_path

    check_new_path(out)
    opened = open_recording(recording)
    first, count = lines_between(opened, first_line, lines, begin, end)
    first = opened.first_available_line if first is None else first
    count = opened.first_line + opened.lines - first if count is None else count
    with stage_progress(f"cutting {count} lines"):
        segment = opened.cut(first, count, tile_of(opened, tile))
        size = _save(segment if merge == 1 else merged(segment, merge), out)
    facts = {"path": str(out), "first_line": first, "lines": count, "bytes": size}
    if json:
        print_json(facts)
    else:
        say(f"{out}: lines {first} to {first + count - 1}, {quantity(size, 'B')}")


def _print_list(title: str, items: Iterable[str]) -> None:
    """Some items under a title; those that are too many are counted."""
    listed = list(items)
    for item in listed[:LISTED]:
        say(f"  {title}: {item}")
    if len(listed) > LISTED:
        say(f"  {title}: and {len(listed) - LISTED} more; --json has them all")


def _may_be_one(path: Path) -> bool:
    """A directory that is a recording, or cannot say what it is; a video says so."""
    from acquire.store import format_of

    try:
        return path.is_dir() and not (format_of(path) or "").startswith("acquire-video/")
    except (AcquireError, OSError):
        return True


def _summary(path: Path) -> dict[str, Any]:
    from acquire.store import open_outline
    from acquire.store.layout import DAMAGE

    try:
        opened = open_outline(path)
        facts = opened.info() | {"damage": _damage(opened)}
    except AcquireError as error:
        return {"path": str(path), "error": error.message}
    except (*DAMAGE, MemoryError) as error:  # whatever is wrong with one, the others are listed
        return {"path": str(path), "error": f"{path} cannot be read: {error}"}
    keys = ("path", "run_id", "state", "run_condition", "lines", "duration_s", "bytes", "start_ns", "damage")
    return {key: facts[key] for key in keys}


def _damage(recording: Outline) -> str | None:
    """What shows without reading the lines: files that are gone or cut short, segments that are not there."""
    from acquire.store.shortfall import first_shortfall, missing_segments

    if not recording.is_here:
        return None  # a store far away would be asked for every file
    found = first_shortfall(recording)
    return next(missing_segments(recording), None) if found is None else str(found)


def _row(facts: dict[str, Any]) -> tuple[str, ...]:
    name = Path(facts["path"]).name
    if "error" in facts:
        # One line of bounded length: an error may quote what lies on the disk.
        why = " ".join(facts["error"].removeprefix(facts["path"]).lstrip(": ").split())
        why = why if len(why) <= CELL_CHARACTERS else why[: CELL_CHARACTERS - 1] + "…"
        return (name, "-", "-", "-", why, "-")
    state = (facts["run_condition"] or facts["state"]) + (", DAMAGED" if facts["damage"] else "")
    size = quantity(facts["bytes"], "B")
    return (name, str(facts["lines"]), f"{facts['duration_s']:.3f} s", size, state, _utc(facts["start_ns"]))


def _readable(facts: dict[str, Any]) -> dict[str, Any]:
    sizes = facts["geometry"]
    first, lines = facts["first_line"], facts["lines"]
    doubt_ns = facts["clock"]["uncertainty_ns"]
    utc = "UTC not known" if doubt_ns >= MOST_NS else f"UTC known to {doubt_ns} ns"
    return {
        "recording": facts["path"],
        "run": facts["run_id"],
        "state": f"{facts['state']}, {facts['run_condition'] or 'no condition yet'}",
        "end": facts["end_reason"],
        "lines": f"{lines} ({first} to {first + lines - 1})" if lines else "0",
        "continues": _outage(facts["segment"]),
        "segments": ", ".join(facts["segments"]) or None,
        "dropped": _stretches(facts["dropped"]),
        "held": _stretches(facts["holds"]),
        "duration": f"{facts['duration_s']:.6f} s at {quantity(facts['line_rate_hz'], 'Hz')}",
        "started": _utc(facts["start_ns"]),
        "geometry": f"M = {sizes['stages']}, S = {sizes['substeps']}, {sizes['pixels']} pixels",
        "scene": _behind_fibre(sizes),
        "samples": facts["dtype"],
        "code": ", ".join(f"{key} {shortened(value, 60)}" for key, value in facts["code"].items()),
        "clock": f"{facts['clock']['clock_hz']} Hz, {utc}",
        "size": quantity(facts["bytes"], "B"),
        "damaged": facts["damage"],
        "disk": _disk(facts["disk"]),
        "at risk": _at_risk(facts["durability"]),
        "lost lines": ", ".join(f"{arm} {count}" for arm, count in facts["lost_lines"].items()),
        "in doubt": _suspect(facts["suspect"]),
        "calibration": _calibration(facts["calibration"], facts["calibration_missing"]),
        "simulated": "yes" if facts["simulated"] else "no",
        "imported": _imported(facts["imported"]),
        "written by": f"acquire {facts['versions']['acquire']}",
    }


def _imported(found: dict[str, Any] | None) -> str | None:
    """Where lines are from that were not recorded, and what is not known of them."""
    if found is None:
        return None
    files = dict.fromkeys(str(file.get("path")) for file in dict(found.get("files", {})).values())
    return f"from {', '.join(files)}; not known: {'; '.join(map(str, found.get('unknown', ())))}"


def _calibration(found: dict[str, Any] | None, missing: str | None) -> str | None:
    """Which steps of a calibration the recording carries, and since when the newest is known."""
    if missing is not None:
        return f"none: {missing}, which the rig named, was not there"
    steps = {} if found is None else dict(found.get("steps", {}))
    if not steps:
        return None
    return f"{', '.join(steps)}; {max(str(step.get('made', '')) for step in steps.values())}"


def _outage(segment: dict[str, Any] | None) -> str | None:
    """What a further segment follows, and what is lost between."""
    if segment is None:
        return None
    outage = segment["outage"]
    lines = "numbering began anew" if outage["lines"] is None else f"{outage['lines']} lines"
    return f"{segment['of']} after line {outage['after_line']}; outage: {lines}, {outage['cause']}"


def _stretches(stretches: list[list[Any]]) -> str | None:
    """Stretches of lines, at most some of them; what has no end is what a copy still needs."""
    from acquire.store.terms import ALL_LINES

    shown = [
        f"{first} on" if count >= ALL_LINES else f"{first} to {first + count - 1}"
        for first, count, *_ in stretches[:LISTED]
    ]
    more = [f"and {len(stretches) - LISTED} more"] if len(stretches) > LISTED else []
    return ", ".join(shown + more) or None


def _suspect(found: list[dict[str, Any]]) -> str | None:
    """Lines that do not follow the light's code."""
    shown = [
        f"{one['arm']} {one['first_line']} to {one['first_line'] + one['count'] - 1} ({one['why']})"
        for one in found[:LISTED]
    ]
    more = [f"and {len(found) - LISTED} more"] if len(found) > LISTED else []
    return ", ".join(shown + more) or None


def _behind_fibre(sizes: dict[str, Any]) -> str | None:
    """Of a recording whose columns see bands of a larger scene."""
    if (fibre := sizes.get("fibre")) is None:
        return None
    side = sizes["stages"] * sizes["substeps"]
    tiles = f"{fibre['rows'] // side} x {fibre['columns'] // side} tiles of {side} x {side}"
    bands = " and ".join(str(len(fibre["bands"][arm])) for arm in ("a", "b"))
    return (
        f"{fibre['rows']} x {fibre['columns']} fine pixels behind a fibre, {tiles}; {bands} bands on a and b"
    )


def _disk(disk: dict[str, float] | None) -> str | None:
    """How long a growing recording can go on."""
    if disk is None:
        return None
    free, rate = quantity(disk["free_bytes"], "B"), quantity(disk["bytes_per_s"], "B/s")
    seconds = min(disk["seconds_to_full"], timedelta.max.total_seconds() / 2)
    return f"{free} free, full in {timedelta(seconds=round(seconds))} at {rate}"


def _at_risk(durability: dict[str, Any]) -> str | None:
    """What a crash can cost, of a recording that says so."""
    if not durability:
        return None
    kill, power = durability["kill_lines"], durability["power_lines"]
    at_power = f"at most {power} lines" if power is not None else "what the system has not written back"
    return f"kill -9: at most {kill} lines; power loss: {at_power} (fsync at {durability['fsync']})"


def _utc(time_ns: int | None) -> str:
    if time_ns is None:
        return "-"
    if not 0 <= time_ns < MOST_NS:
        return f"{time_ns} ns after 1970"
    return datetime.fromtimestamp(time_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")


def _save(segment: Segment, out: Path) -> int:
    """Write the segment; a file that is there is whole. The file's size."""
    import numpy as np

    from acquire.store.delivery import whole_file
    from acquire.store.refusals import refused

    with whole_file(out) as part, refused(out, "written"), part.open("wb") as file:
        np.savez(
            file,
            lines=segment.lines,
            mask=segment.mask,
            code=segment.code,
            time_ns=segment.time_ns,
            stages=segment.geometry.stages,
            substeps=segment.geometry.substeps,
            first_line=segment.first_line,
            first_column=segment.first_column,
            substep_ns=segment.substep_ns,
            black_level_dn=segment.black_level_dn,
            responsivity_dn=segment.responsivity_dn,
        )
    return out.stat().st_size
