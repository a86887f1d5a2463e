"""What `acquire info` and `acquire ls` show: the facts of a recording in words and columns."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.cli.output import quantity
from acquire.store import taint_words
from acquire.text import counted, shortened

if TYPE_CHECKING:
    from collections.abc import Sequence

LISTED = 20
"""Number of items of a list that are printed; --json has all of them."""

MOST_NS = 2**62
"""Upper limit of a time after 1970 that a calendar date can express; a clock this uncertain is unknown."""

CELL_CHARACTERS = 72
"""Longest error text in a table; --json has all of it."""

COLUMNS = ("recording", "lines", "duration", "size", "state", "started (UTC)")


def list_row(facts: dict[str, Any]) -> tuple[str, ...]:
    """Return the row of a recording in a list, or of a directory that cannot be read as one."""
    name = Path(facts["path"]).name
    if "error" in facts:
        # One line of limited length, because an error may quote what is on the disk.
        # The row begins with the name already.
        why = " ".join(facts["error"].removeprefix(facts["path"]).lstrip(": ").split())
        why = why if len(why) <= CELL_CHARACTERS else why[: CELL_CHARACTERS - 1] + "…"
        return (name, "-", "-", "-", why, "-")
    state = (facts["run_condition"] or facts["state"]) + (", DAMAGED" if facts["damage"] else "")
    state += ", not sealed" if _is_left(facts) else ""
    size = quantity(facts["bytes"], "B")
    return (name, str(facts["lines"]), f"{facts['duration_s']:.3f} s", size, state, _utc(facts["start_ns"]))


def recording_facts(facts: dict[str, Any]) -> dict[str, Any]:
    """Return the facts of one recording by their labels; None for those that do not apply."""
    from acquire.store.terms import ALL_LINES

    sizes, segment, missing = facts["geometry"], facts["segment"], facts["calibration_missing"]
    first, lines = facts["first_line"], facts["lines"]
    uncertainty_ns = facts["clock"]["uncertainty_ns"]
    utc = "UTC unknown" if uncertainty_ns >= MOST_NS else f"UTC known to {uncertainty_ns} ns"

    def ranges(key: str) -> str | None:
        """Format ranges of lines. One without an end is held for a copy that is still running."""
        return _some(
            [
                f"{start} on" if count >= ALL_LINES else f"{start} to {start + count - 1}"
                for start, count, *_ in facts[key]
            ]
        )

    continues = calibration = None
    if segment is not None:  # it continues a recording after an outage
        outage = segment["outage"]
        lost = "the numbering restarted" if outage["lines"] is None else counted(outage["lines"], "line")
        continues = f"{segment['of']} after line {outage['after_line']}; outage: {lost}, {outage['cause']}"
    if missing is not None:
        calibration = f"none: {missing}, named in the rig file, did not exist"
    elif steps := dict((facts["calibration"] or {}).get("steps", {})):
        # ISO times: the greatest text is the latest.
        calibration = f"{', '.join(steps)}; {max(str(step.get('made', '')) for step in steps.values())}"
    # A daemon recovers it when it starts; without one, the command does.
    left = "; no process writes it any more: acquire recover" if _is_left(facts) else ""
    # What a damaged table would tell is unknown, and not nothing.
    doubts: str | None = "unknown, since the events cannot be read"
    if facts["suspect"] is not None:
        doubts = _some(
            [
                f"{one['arm']} {one['first_line']} to {one['first_line'] + one['count'] - 1} ({one['why']})"
                for one in facts["suspect"]
            ]
        )
    lost = "unknown, since the gaps cannot be read"
    if facts["lost_lines"] is not None:
        lost = ", ".join(f"{arm} {count}" for arm, count in facts["lost_lines"].items())
    # Held lines are kept all the same, and the disk may fill although there is a limit.
    most, beyond = facts["max_bytes"], ""
    if facts["holds"] and most is not None and facts["bytes"] > most:
        beyond = f", more than recording.retention.max_gb allows ({quantity(most, 'B')}): lines are held"
    return {
        "recording": facts["path"],
        "run": facts["run_id"],
        "state": f"{facts['state']}, {facts['run_condition'] or 'no condition yet'}{left}",
        "end": facts["end_reason"],
        "lines": f"{lines} ({first} to {first + lines - 1})" if lines else "0",
        "continues": continues,
        "segments": ", ".join(facts["segments"]) or None,
        "dropped": ranges("dropped"),
        "held": ranges("holds"),
        "duration": f"{facts['duration_s']:.6f} s at {quantity(facts['line_rate_hz'], 'Hz')}",
        "started": _utc(facts["start_ns"]),
        "geometry": f"M = {sizes['stages']}, S = {sizes['substeps']}, {sizes['pixels']} pixels",
        "scene": _behind_fibre(sizes),
        "samples": facts["dtype"],
        "not readable": facts["codec_missing"],
        # Listed bits may be a megabyte of digits. Without a seed, the register's state was given itself.
        "code": ", ".join(
            f"{key} {shortened(value, 60)}" for key, value in facts["code"].items() if value is not None
        ),
        "clock": f"{facts['clock']['clock_hz']} Hz, {utc}",
        "size": quantity(facts["bytes"], "B") + beyond,
        "damaged": facts["damage"],
        "disk": _disk(facts["disk"]),
        "at risk": _at_risk(facts["durability"]),
        "lost lines": lost,
        "incomplete": "; ".join(facts["tables_lack"]) or None,
        "tainted by": _some(taint_words(facts["ledger"].get("tainted_by", {}))),
        "in doubt": doubts,
        "calibration": calibration,
        "simulated": "yes" if facts["simulated"] else "no",
        "imported": _imported(facts["imported"]),
        "written by": f"acquire {facts['versions']['acquire']}",
        "plug-ins": _some(
            [
                f"{one['kind']} {one['name']} of {one['distribution']} {one['version']}"
                for one in facts["plugins"] or ()
            ]
        ),
    }


def what_to_try(place: object, damage: str) -> str:
    """Return what to try with a damaged recording."""
    listing = f"acquire verify {place}, which lists all damage"
    if "its file cannot be read" in damage:
        # Its lines may come back: they must not be flagged as missing.
        return f"the disk, and the permissions of the files; {listing}"
    if damage.startswith("its segment "):
        return f"the segment from a copy; {listing}"
    return f"{listing}; acquire recover {place}, which flags what is lost as missing"


def _is_left(facts: dict[str, Any]) -> bool:
    """Whether its writer has ended without sealing it."""
    return facts["state"] != "sealed" and facts["written"] is False


def _some(items: Sequence[str]) -> str | None:
    """Join up to `LISTED` items and count the others; None if there are none."""
    more = [f"and {len(items) - LISTED} more"] if len(items) > LISTED else []
    return ", ".join([*items[:LISTED], *more]) or None


def _imported(found: dict[str, Any] | None) -> str | None:
    """The source files of an imported recording, and what is not known about its lines."""
    if found is None:
        return None
    # Once: both arms may come from the same file.
    files = dict.fromkeys(str(file.get("path")) for file in dict(found.get("files", {})).values())
    return f"from {', '.join(files)}; not known: {'; '.join(map(str, found.get('unknown', ())))}"


def _behind_fibre(sizes: dict[str, Any]) -> str | None:
    """The size of a scene behind a fibre, its tiles and its fibre bands."""
    if (fibre := sizes.get("fibre")) is None:
        return None
    side = sizes["stages"] * sizes["substeps"]
    tiles = f"{fibre['rows'] // side} x {fibre['columns'] // side} tiles of {side} x {side}"
    bands = " and ".join(str(len(fibre["bands"][arm])) for arm in ("a", "b"))
    return (
        f"{fibre['rows']} x {fibre['columns']} fine pixels behind a fibre, {tiles}; "
        f"{bands} fibre bands on arms a and b"
    )


def _disk(disk: dict[str, float] | None) -> str | None:
    """How long a growing recording can continue on its disk."""
    if disk is None:
        return None
    free, rate = quantity(disk["free_bytes"], "B"), quantity(disk["bytes_per_s"], "B/s")
    # A disk that hardly fills lasts for longer than timedelta can express.
    seconds = min(disk["seconds_to_full"], timedelta.max.total_seconds() / 2)
    return f"{free} free, full in {timedelta(seconds=round(seconds))} at {rate}"


def _at_risk(durability: dict[str, Any]) -> str | None:
    """The number of lines that a crash can cost."""
    if not durability:
        return None
    kill, power = durability["kill_lines"], durability["power_lines"]
    at_power = (
        f"at most {power} lines" if power is not None else "all that the system has not written to disk"
    )
    return f"kill -9: at most {kill} lines; power loss: {at_power} (fsync at {durability['fsync']})"


def _utc(time_ns: int | None) -> str:
    if time_ns is None:
        return "-"
    if not 0 <= time_ns < MOST_NS:
        return f"{time_ns} ns after 1970"
    # To microseconds, which a float of seconds since 1970 still resolves.
    return datetime.fromtimestamp(time_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")
