"""What `acquire status` shows: the daemon's status, a JSON document, in words and columns."""

from __future__ import annotations

from datetime import datetime
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from acquire.cli.output import fact_lines, print_json, quantity, say, table_lines
from acquire.text import counted

if TYPE_CHECKING:
    from acquire.daemon.messages import Status

Facts = dict[str, Any]
"""Part of the status document, see `acquire.daemon.messages`."""

RECOVERIES = UPLOADS = TROUBLES = 3
"""Number of unsealed recordings, uploads and problems that are printed; --json has more."""


def show(status: Status, json: bool) -> None:
    """Print the status that a command has returned."""
    show_document(status.model_dump(mode="json"), json)


def show_document(status: Facts, json: bool) -> None:
    """Print a status document."""
    if json:
        print_json(status)
        return
    for line in status_lines(status):
        say(line)


def status_lines(status: Facts) -> list[str]:
    """Return the status as lines of text.

    Raises LookupError, TypeError or ValueError if the document is not a status.
    """
    since = datetime.fromisoformat(status["since"])
    last = status["last"]
    if last is not None:
        condition = last["condition"] or "not sealed"
        last = f"{last['path']}, {counted(last['lines'], 'line')}, {condition} ({last['end_reason']})"
    troubles = [f"{one['text']} ({counted(one['times'], 'time')})" for one in status["troubles"][-TROUBLES:]]
    facts = {
        "state": f"{status['state']} since {since:%Y-%m-%d %H:%M:%S} UTC",
        "busy": status["busy"],
        "waiting": status["waiting"],
        "fault": status["fault"],
        "rig": f"{status['name']} (process {status['pid']}, up {status['uptime_s']:.0f} s)",
        "run": status["run_id"],
        "recording": _recording(status),
        "last": last,
        "not sealed": _recoveries(status),
        "uploads": _uploads(status),
        "disk": _trouble_with_disk(status) or _disk(status["disk"]),
        "trigger": _trigger(status["trigger"]),
        "sustains": _capacity(status),
        "light": _light(status),
        "calibration": status["calibration"] and status["calibration"]["text"],
        "troubles": "; ".join(troubles) or None,
        "possible": ", ".join(status["possible"]),
    }
    arms = status["arms"]
    if not arms:
        return fact_lines(facts)
    # one column for each arm, so that the table fits the narrowest terminal
    columns = [_arm(arm) for arm in arms.values()]
    rows = [(name, *(column[name] for column in columns)) for name in columns[0]]
    return [*fact_lines(facts), "", *table_lines(("arm", *arms), rows)]


def status_line(status: Facts) -> str:
    """Return the status as one line, for `--watch` in a pipe."""
    arms = status["arms"]
    lost = sum(sum(arm["lost"].values()) for arm in arms.values())
    # Of the fuller one, which is the first to have no room.
    full = max((arm["ring"]["fill"] / arm["ring"]["slots"] for arm in arms.values()), default=0.0)
    now = status["recording"]
    recording = f", {PurePath(now['path']).name} {counted(now['recorded_lines'], 'line')}" if now else ""
    waits = status["busy"] or status["waiting"] or _trouble_with_disk(status)
    more = f", {waits}" if waits else ""
    return f"{status['state']}{recording}, lost {lost}, rings {full:.0%}{more}"


def _recording(status: Facts) -> str | None:
    now = status["recording"]
    if now is None:
        return None
    budget = "" if now["budget_lines"] is None else f" of {now['budget_lines']}"
    held = ""
    if beyond := now.get("beyond_bytes", 0):
        more = quantity(beyond, "B")
        held = f"; WARNING: {more} more than recording.retention.max_gb allows: lines are held"
    return (
        f"{now['path']}, {now['recorded_lines']}{budget} lines from line {now['first_line']}, "
        f"{now['committed_lines']} readable{held}"
    )


def _capacity(status: Facts) -> str | None:
    found = status["capacity"]
    if found is None or found["warning"] is not None:
        return None if found is None else f"WARNING: {found['warning']}"
    sustained, configured = quantity(found["sustained_hz"] or 0, "Hz"), quantity(found["line_rate_hz"], "Hz")
    with_codec = "" if found["codec"] in (None, "none") else f" with {found['codec']}"
    return f"lines at {sustained}{with_codec} (limited by the {found['limit']}); configured {configured}"


def _recoveries(status: Facts) -> str | None:
    """Recordings that were not sealed by their recorder, and the results of their recovery."""
    # The state says already that it was recovered.
    shown = [
        f"{PurePath(one['path']).name} {one['state']}: {one['text'].removeprefix('recovered: ')}"
        for one in status["recoveries"][-RECOVERIES:]
    ]
    more = len(status["recoveries"]) - len(shown)
    return "; ".join([*shown, *([f"and {more} earlier"] if more else [])]) or None


def _uploads(status: Facts) -> str | None:
    """Uploads of recordings to the remote store, with the unfinished ones last."""
    shown = [f"WARNING: {status['upload_warning']}"] if status["upload_warning"] else []
    if status["uploads_left"] > UPLOADS:
        shown.append(f"{counted(status['uploads_left'], 'recording', 'is')} not copied yet")
    for one in sorted(status["uploads"], key=lambda one: one["state"] != "copied")[-UPLOADS:]:
        waiting = f", {one['waiting_lines']} not yet copied" if one["waiting_lines"] else ""
        why = f": {one['error']}" if one["error"] else ""
        hint = f" (try: {one['hint']})" if one["error"] and one["hint"] else ""
        name = PurePath(one["path"]).name
        shown.append(f"{name} {one['state']}, {counted(one['lines'], 'line')} copied{waiting}{why}{hint}")
    return "; ".join(shown) or None


def _arm(arm: Facts) -> dict[str, str]:
    ring, ledger, check = arm["ring"], arm["ledger"], arm["check"]
    code = "-" if check is None else check["verdict"].replace("_", " ")
    if check is not None and check["shift"]:
        code = f"{code} {check['shift']:+d}"
    return {
        "rate": quantity(arm["rate_hz"], "Hz"),
        "delivered": str(arm["delivered"]),
        "preroll": str(arm["preroll"]),
        "recorded": str(arm["recorded"]),
        "missing": str(arm["missing"]),
        # Only the causes that have lost lines: the others would make the column wider than a terminal.
        "lost": ", ".join(f"{cause} {lines}" for cause, lines in arm["lost"].items() if lines) or "0",
        "saturated": f"{arm['saturated']} ({arm['saturated_part']:.1%} now)",
        "ring": f"{ring['fill']} of {ring['slots']}, peak {ring['peak']}",
        "drops": str(ring["drops"]),
        "code": code,
        "clock": f"{arm['drift_ppb'] / 1000:+.3f} ppm" if arm["drift_ppb"] else "-",
        "ledger": "-" if ledger is None else "balances" if ledger["balanced"] else "DOES NOT BALANCE",
    }


def _trigger(trigger: Facts | None) -> str | None:
    if trigger is None:
        return None
    answers = "answers" if trigger["answers"] else f"SILENT for {trigger['silent_s']:.0f} s"
    clock = (
        f"clock {quantity(trigger['clock_hz'], 'Hz')}, UTC known to {trigger['uncertainty_ns'] / 1000:.3g} us"
    )
    return f"{answers}, {counted(trigger['pulses'], 'line')}, {clock}"


def _light(status: Facts) -> str | None:
    light = status.get("light")
    return None if light in (None, "rig") else f"WARNING: {without_code(light)}"


def without_code(light: str) -> str:
    """Return what a run is not good for whose light is ``"dark"`` or ``"steady"``, and what to do."""
    state = "off" if light == "dark" else "on"
    return (
        f"the light stays {state}, as for a calibration, so that no video can be reconstructed from these "
        "lines; for the rig's code: acquire disarm, then acquire arm"
    )


def _trouble_with_disk(status: Facts) -> str | None:
    trouble = status.get("disk_trouble")
    return trouble and f"WARNING: {trouble}"


def _disk(disk: Facts | None) -> str | None:
    """The free space, and how long recordings can continue."""
    if disk is None:
        return None
    seconds, free = disk["seconds_to_full"], quantity(disk["free_bytes"], "B")
    left = f"{seconds:.0f} s"
    for unit, length_s in (("min", 60), ("h", 3600), ("days", 86400), ("years", 365.25 * 86400)):
        # From two of a unit on: 90 min say more than 1.5 h.
        if (count := seconds / length_s) >= 2:
            # No exponent even for a disk that hardly fills, which lasts for thousands of years.
            left = f"{count:.3g} {unit}" if count < 999.5 else f"{count:.0f} {unit}"
    return f"{disk['directory']}, {free} free, full in {left} at {quantity(disk['bytes_per_s'], 'B/s')}"
