"""``acquire ls | info | verify | recover | hold | upload | cut``: work with recordings, without a daemon."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.completion import recordings
from acquire.cli.output import JsonFlag, print_facts, print_json, print_table, print_warning, quantity, say
from acquire.cli.places import given_path, local_directory, local_path
from acquire.cli.progress import stage_progress
from acquire.cli.recording_page import COLUMNS, LISTED, list_row, recording_facts, what_to_try
from acquire.cli.stretch import FirstLineOption, FromOption, LinesOption, ToOption, lines_between
from acquire.cli.tiles import TileOption, tile_of
from acquire.errors import AcquireError, DataError, UsageError
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Iterable

    from acquire.store import Mirrored, Outline

PlaceArgument = Annotated[
    str,
    typer.Argument(
        metavar="RECORDING",
        autocompletion=recordings,
        help="Recording: a directory NAME.zarr, or its URL, such as s3://bucket/NAME.zarr.",
        parser=given_path,
    ),
]

RecordingArgument = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING",
        autocompletion=recordings,
        help="Recording: a directory NAME.zarr on this machine.",
        parser=local_path,
    ),
]


def register(app: typer.Typer) -> None:
    app.command("ls", rich_help_panel="Recordings")(list_recordings)
    for command in (info, verify, recover, hold, upload, cut):
        app.command(rich_help_panel="Recordings")(command)


def list_recordings(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="Directory to list.", parser=local_directory)
    ] = Path(),
    json: JsonFlag = False,
) -> None:
    """List the recordings in a directory, or one recording. Damaged ones are marked.

    Videos and calibrations are not listed.

    Example: [bold]acquire ls /data[/]
    """
    from acquire.store import open_outline
    from acquire.store.listing import candidates
    from acquire.store.refusals import refused

    with refused(directory, "listed", "a directory of recordings; `acquire info` describes one"):
        named = candidates(directory)
        # A recording was named itself, and not a directory of them.
        if (directory / "zarr.json").is_file():
            named = [directory.absolute()]  # "." has no name to list
    found = [facts for path in named if (facts := _summary(path)) is not None]
    if not found and named == [directory.absolute()]:
        open_outline(directory)  # which says what it is, and what shows it
    if json:
        print_json(found)
    elif not found:
        kinds = Counter(kind for path in named if (kind := _other_kind(path)) is not None)
        others = ", ".join(f"{count} {kind}{'s' * (count > 1)}" for kind, count in sorted(kinds.items()))
        say(f"there are no recordings in {directory}" + (f", but {others}" if others else ""))
    else:
        print_table(COLUMNS, map(list_row, found))
        _print_damage(found)


def info(recording: PlaceArgument, json: JsonFlag = False) -> None:
    """Show what a recording holds: its geometry, code, clock and losses, and how it ended.

    Example: [bold]acquire info run.zarr[/]
    """
    from acquire.store import open_outline, suspect_lines

    opened = open_outline(recording)
    facts = opened.info() | {"damage": _damage(opened)}
    # None: the table that would say so cannot be read, and neither can `gaps` be used.
    facts["suspect"] = None
    if "events" not in opened.unreadable:
        facts["suspect"] = [found.to_dict() for found in suspect_lines(opened)]
    gaps = () if "gaps" in opened.unreadable else opened.gaps
    if json:
        listed = [
            {"arm": gap.arm, "first_line": gap.first_line, "count": gap.count, "cause": gap.cause}
            for gap in gaps
        ]
        print_json({**facts, "gap_list": listed})
        return
    print_facts(recording_facts(facts))
    if gaps:
        say()
        rows = [(gap.arm, gap.first_line, gap.count, gap.cause) for gap in gaps]
        print_table(("arm", "first lost line", "lines", "cause"), rows)


def verify(recording: PlaceArgument, json: JsonFlag = False) -> None:
    """Read a whole recording and check that every line is intact, and that numbering, gaps and ledger agree.

    If something is damaged, the command lists it and the exit code is 6. Lines that are flagged as missing
    do not count as damage: they were lost before, or recover has flagged them, and info lists them.

    Example: [bold]acquire verify run.zarr[/]
    """
    from acquire.store import verify as verify_recording

    with stage_progress(f"verifying {recording}") as progress:
        found = verify_recording(recording, progress)
    if json:
        print_json(found.to_dict())
    else:
        verdict = "DAMAGED" if not found.intact else "recovered" if found.recovered else "intact"
        size = quantity(found.bytes, "B")
        say(f"{found.path}: {verdict}; {found.state}, {counted(found.lines, 'line')}, {size}")
        # Lists end after `LISTED` items: a recording on a failing disk may have thousands.
        _print_list("not intact on disk", map(str, found.damage))
        _print_list("lost, flagged as missing", map(str, found.recovered))
        _print_list("contradictions", found.contradictions)
        _print_list("note", found.notes)
        if any("cannot be read" not in each.what for each in found.damage) and "://" not in recording:
            say(f"  to try: acquire recover {recording}, which flags what is lost as missing")
    if not found.intact:
        # No message: the list above, or the JSON, says what is wrong.
        raise typer.Exit(DataError.exit_code)


def recover(recording: RecordingArgument, json: JsonFlag = False) -> None:
    """Seal a recording whose writer was killed or lost power. All committed lines are kept.

    Lines that are not intact on disk are flagged as missing and listed. Running the command again changes
    nothing.

    Example: [bold]acquire recover run.zarr[/]
    """
    from acquire.store import recover as recover_recording

    with stage_progress(f"recovering {recording}") as progress:
        done = recover_recording(recording, progress=progress)
    if json:
        print_json(done.to_dict())
        return
    added = done.lines - done.lines_before
    found = f"; {counted(added, 'line', 'was')} on disk that no commit listed" if added else ""
    what = f"recovered and sealed{found}" if done.changed else "nothing to recover"
    say(f"{done.path}: {counted(done.lines, 'line')}, {what}")
    if done.root_rebuilt:
        say("  its root zarr.json was lost and has been rewritten from the copy of its attributes")
    if done.not_listed:
        say(f"  it is not listed in the first recording of its run: {done.not_listed}")
    if done.indices_mended:
        indices = "indices of files were" if done.indices_mended > 1 else "index of a file was"
        say(f"  {done.indices_mended} {indices} repaired")
    _print_list("lost of a table", done.tables_lost.values())
    _print_list("lost, flagged as missing", map(str, done.damage))


def hold(
    recording: RecordingArgument,
    first_line: Annotated[
        int | None,
        typer.Option(help="Number of the first line, as counted by the trigger. Required without --from."),
    ] = None,
    lines: Annotated[
        int | None,
        typer.Option(
            help="Number of lines, possibly including lines that are not recorded yet. Required without --to."
        ),
    ] = None,
    begin: FromOption = None,
    end: ToOption = None,
    why: Annotated[
        str, typer.Option(metavar="TEXT", help="Reason, stored with the held lines (up to 200 characters).")
    ] = "",
    json: JsonFlag = False,
) -> None:
    """Keep lines of an endless recording, and the neighbours needed to reconstruct them, from being dropped.

    If some of the lines are gone already, the others are held and the exit code is 6.

    Example: [bold]acquire hold run.zarr --first-line 2000 --lines 5000 --why flash[/]
    """
    from acquire.store import hold as hold_lines
    from acquire.store import open_recording

    first, count = lines_between(open_recording(recording), first_line, lines, begin, end, to_come=True)
    if first is None or count is None:
        raise UsageError(
            "hold needs the first line and the number of lines",
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
        str,
        typer.Argument(
            metavar="URL",
            help="URL of the copy: s3://bucket/NAME.zarr, or any other URL that fsspec supports.",
            parser=given_path,
        ),
    ],
    follow: Annotated[
        bool, typer.Option("--follow", help="Keep copying until the recording is sealed.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Copy a recording to a remote store, even while it grows. An interrupted copy is continued.

    Lines that are not copied yet are held, so that an endless recording does not drop them.

    Example: [bold]acquire upload run.zarr s3://bucket/run.zarr --follow[/]
    """
    from acquire.store import mirror
    from acquire.store.remote import be_patient

    # Before the store's library reads the environment.
    be_patient()

    def report(done: Mirrored) -> None:
        if not json:
            # Standard output is for the result.
            say(f"{url}: {counted(done.lines, 'line')}, {quantity(done.bytes, 'B')} copied", err=True)

    with stage_progress(f"copying {recording.name}") as progress:
        done = mirror(recording, url, follow=follow, report=report, progress=progress)
    if json:
        print_json(done.to_dict())
    else:
        state = "sealed" if done.sealed else "still growing"
        say(f"{url}: {counted(done.lines, 'line')}, {state}; {quantity(done.bytes, 'B')} copied now")


def cut(
    recording: PlaceArgument,
    out: Annotated[Path, typer.Option(metavar="FILE.npz", help="New NumPy file to write.")],
    first_line: FirstLineOption = None,
    lines: LinesOption = None,
    begin: FromOption = None,
    end: ToOption = None,
    merge: Annotated[
        int,
        typer.Option(
            min=1,
            help="Sum blocks of this many lines by this many columns, for a sensor without intra-line charge "
            "transfer. 1: no sums.",
        ),
    ] = 1,
    tile: TileOption = None,
    json: JsonFlag = False,
) -> None:
    """Write a range of lines of both arms to an npz file: lines, mask, code, time_ns, stages, substeps,
    scales.

    --merge 3 turns 192 stages that were triggered at every sub-step into 64 stages with 3 sub-steps.

    Example: [bold]acquire cut run.zarr --first-line 2000 --lines 256 --out segment.npz[/], or
    [bold]acquire cut run.zarr --from 52ms --to 60ms --out segment.npz[/]
    """
    import numpy as np

    from acquire.lines import merged
    from acquire.store import open_recording
    from acquire.store.delivery import check_new_file, whole_file
    from acquire.store.refusals import refused

    # Now, and not only when it is written: reading and merging may take minutes.
    if out.suffix.lower() != ".npz":
        raise UsageError(
            f"cut cannot write {str(out)!r}: its result is a NumPy archive, and is named so",
            possible="NAME.npz; acquire export writes lines in other formats",
            # pathlib has no suffix for a name that is only a dot
            hint=f"--out {out.with_suffix('.npz')}" if out.name.strip(".") else "",
        )
    check_new_file(out)
    opened = open_recording(recording)
    first, count = lines_between(opened, first_line, lines, begin, end)
    # Retention may have dropped the first lines of an endless recording.
    first = opened.first_available_line if first is None else first
    count = opened.first_line + opened.lines - first if count is None else count
    with stage_progress(f"cutting {counted(count, 'line')}"):
        segment = opened.cut(first, count, tile_of(opened, tile))
        if merge != 1:
            segment = merged(segment, merge)
        # As an open file: NumPy would add .npz to the name of the unfinished one.
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
        size = out.stat().st_size
    facts = {"path": str(out), "first_line": first, "lines": count, "bytes": size}
    if json:
        print_json(facts)
    else:
        say(f"{out}: lines {first} to {first + count - 1}, {quantity(size, 'B')}")


def _print_list(title: str, items: Iterable[str]) -> None:
    """Print up to `LISTED` items with a title, and count the others."""
    listed = list(items)
    for item in listed[:LISTED]:
        say(f"  {title}: {item}")
    if len(listed) > LISTED:
        say(f"  {title}: and {len(listed) - LISTED} more; --json has them all")


def _print_damage(found: Iterable[dict[str, Any]]) -> None:
    """Print what is wrong with the recordings of a list, and what to try."""
    damaged = [each for each in found if each.get("damage") or each.get("hint")]
    # Standard output is for the list.
    for each in damaged[:LISTED]:
        if "error" in each:
            print_warning(f"{each['error']}; try: {each['hint']}")
        else:
            place, damage = each["path"], each["damage"]
            print_warning(f"{place}: {damage}; try: {what_to_try(place, damage)}")
    if len(damaged) > LISTED:
        print_warning(f"{len(damaged) - LISTED} more are damaged; --json has them all")


def _summary(path: Path) -> dict[str, Any] | None:
    """Return the facts of a recording for a list, or its error; None for a plain file and what is listed
    elsewhere.
    """
    from acquire.store import open_outline
    from acquire.store.layout import DAMAGE
    from acquire.text import cause_in_words

    try:
        # A recording on a disk that is not mounted must not be left out without a word.
        if path.is_symlink() and not path.exists():
            return {"path": str(path), "error": f"{path}: a link to {path.readlink()}, which does not exist"}
        if not path.is_dir() or _other_kind(path) is not None:
            return None
    except OSError:
        pass  # it may be a damaged recording, which is reported below
    try:
        opened = open_outline(path)
        facts = opened.info() | {"damage": _damage(opened)}
    except AcquireError as error:
        return {"path": str(path), "error": error.message, "hint": error.hint}
    except (*DAMAGE, MemoryError) as error:  # one damaged recording must not keep the others off the list
        return {"path": str(path), "error": f"{path} cannot be read: {cause_in_words(error)}"}
    keys = ("path", "run_id", "state", "written", "run_condition", "lines")
    return {key: facts[key] for key in (*keys, "duration_s", "bytes", "start_ns", "damage")}


def _other_kind(path: Path) -> str | None:
    """Return "video" or "calibration"; None for anything else."""
    from acquire.store import format_of
    from acquire.store.opening import other_kind

    try:
        return other_kind(format_of(path))
    except (AcquireError, OSError):
        return None


def _damage(recording: Outline) -> str | None:
    """Find damage that shows without reading the lines."""
    from acquire.store.shortfall import damage_in_words

    if not recording.is_here:
        # Looking for files would cost a request to the remote store for each.
        return "; ".join(recording.unreadable.values()) or None
    return damage_in_words(recording)
