"""What `acquire status` shows: the daemon's answer, a JSON document, in words and columns."""

from __future__ import annotations

from datetime import datetime
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from acquire.cli.output import fact_lines, print_json, quantity, say, table_lines

if TYPE_CHECKING:
    from acquire.daemon.messages import Status

Facts = dict[str, Any]
"""A part of the status as JSON: see `acquire.daemon.messages`."""

RECOVERIES = UPLOADS = TROUBLES = 3
"""Recordings not sealed, or on their way to a store, of which the status tells in words; --json has more."""


def show(status: Status, json: bool) -> None:
    """Print what a command came back with."""
    show_document(status.model_dump(mode="json"), json)


def show_document(status: Facts, json: bool) -> None:
    """The same of the document."""
    if json:
        print_json(status)
        return
    for line in status_lines(status):
        say(line)


def status_lines(status: Facts) -> list[str]:
    """The status in words. Raises LookupError, TypeError or ValueError for a document that is none."""
    since = datetime.fromisoformat(status["since"])
    facts = {
        "state": f"{status['state']} since {since:%Y-%m-%d %H:%M:%S} UTC",
        "busy": status["busy"],
        "waiting": status["waiting"],
        "fault": status["fault"],
        "rig": f"{status['name']} (process {status['pid']}, up {status['uptime_s']:.0f} s)",
        "run": status["run_id"],
        "recording": _recording(status),
        "last": _last(status["last"]),
        "not sealed": _recoveries(status),
        "uploads": _uploads(status),
        "disk": _disk(status["disk"]),
        "trigger": _trigger(status["trigger"]),
        "sustains": _capacity(status),
        "calibration": status["calibration"] and status["calibration"]["text"],
        "troubles": _troubles(status),
        "possible": ", ".join(status["possible"]),
    }
    return [*fact_lines(facts), *_arm_lines(status["arms"])]


def status_line(status: Facts) -> str:
    """The status in one line, for those who follow it."""
    arms = status["arms"]
    lost = sum(sum(arm["lost"].values()) for arm in arms.values())
    full = max((arm["ring"]["fill"] / arm["ring"]["slots"] for arm in arms.values()), default=0.0)
    now = status["recording"]
    recording = f", {PurePath(now['path']).name} {now['recorded_lines']} lines" if now else ""
    more = f", {status['busy'] or status['waiting']}" if status["busy"] or status["waiting"] else ""
    return f"{status['state']}{recording}, lost {lost}, rings {full:.0%}{more}"


def _recording(status: Facts) -> str | None:
    now = status["recording"]
    if now is None:
        return None
    budget = "" if now["budget_lines"] is None else f" of {now['budget_lines']}"
    return (
        f"{now['path']}, {now['recorded_lines']}{budget} lines from line {now['first_line']} on, "
        f"{now['committed_lines']} readable"
    )


def _capacity(status: Facts) -> str | None:
    found = status["capacity"]
    if found is None or found["warning"] is not None:
        return None if found is None else f"WARNING: {found['warning']}"
    sustained, configured = quantity(found["sustained_hz"] or 0, "Hz"), quantity(found["line_rate_hz"], "Hz")
    with_codec = "" if found["codec"] in (None, "none") else f" with {found['codec']}"
    return f"lines at {sustained}{with_codec} (the {found['limit']} allows least); configured {configured}"


def _last(last: Facts | None) -> str | None:
    if last is None:
        return None
    return (
        f"{last['path']}, {last['lines']} lines, {last['condition'] or 'not sealed'} ({last['end_reason']})"
    )


def _recoveries(status: Facts) -> str | None:
    """Recordings that their recorder did not seal, and what the daemon made of them."""
    shown = [
        f"{PurePath(one['path']).name} {one['state']}: {one['text'].removeprefix('recovered: ')}"
        for one in status["recoveries"][-RECOVERIES:]
    ]
    more = len(status["recoveries"]) - len(shown)
    return "; ".join([*shown, *([f"and {more} before"] if more else [])]) or None


def _uploads(status: Facts) -> str | None:
    """Recordings on their way to the remote store, those that are not there yet last."""
    found = sorted(status["uploads"], key=lambda one: one["state"] != "copied")
    shown = [f"WARNING: {status['upload_warning']}"] if status["upload_warning"] else []
    if status["uploads_left"] > UPLOADS:
        shown.append(f"{status['uploads_left']} recordings are not copied yet")
    return "; ".join([*shown, *map(_upload, found[-UPLOADS:])]) or None


def _troubles(status: Facts) -> str | None:
    """Failures in what nobody asked for; the daemon's log has more of them."""
    shown = [f"{one['text']} ({one['times']} times)" for one in status["troubles"][-TROUBLES:]]
    return "; ".join(shown) or None


def _upload(one: Facts) -> str:
    waiting = f", {one['waiting_lines']} more here" if one["waiting_lines"] else ""
    why = f": {one['error']}" if one["error"] else ""
    hint = f" (try: {one['hint']})" if one["error"] and one["hint"] else ""
    return f"{PurePath(one['path']).name} {one['state']}, {one['lines']} lines there{waiting}{why}{hint}"


def _arm_lines(arms: Facts) -> list[str]:
    """A column for each arm: as narrow as a terminal can be."""
    if not arms:
        return []
    columns = [_arm(arm) for arm in arms.values()]
    return ["", *table_lines(("arm", *arms), [(name, *(c[name] for c in columns)) for name in columns[0]])]


def _arm(arm: Facts) -> dict[str, str]:
    ring, ledger = arm["ring"], arm["ledger"]
    return {
        "rate": quantity(arm["rate_hz"], "Hz"),
        "delivered": str(arm["delivered"]),
        "preroll": str(arm["preroll"]),
        "recorded": str(arm["recorded"]),
        "missing": str(arm["missing"]),
        "lost": ", ".join(f"{cause} {lines}" for cause, lines in arm["lost"].items() if lines) or "0",
        "saturated": f"{arm['saturated']} ({arm['saturated_part']:.1%} now)",
        "ring": f"{ring['fill']} of {ring['slots']}, peak {ring['peak']}",
        "drops": str(ring["drops"]),
        "code": _check(arm["check"]),
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
    return f"{answers}, {trigger['pulses']} lines, {clock}"


def _disk(disk: Facts | None) -> str | None:
    """How long recordings can go on."""
    if disk is None:
        return None
    rate = quantity(disk["bytes_per_s"], "B/s")
    return (
        f"{disk['directory']}, {quantity(disk['free_bytes'], 'B')} free, "
        f"full in {_long(disk['seconds_to_full'])} at {rate}"
    )


def _long(seconds: float) -> str:
    """A time that is looked at, not calculated with."""
    for unit, length_s in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length_s:
            return f"{seconds / length_s:.3g} {unit}"
    return f"{seconds:.0f} s"


def _check(check: Facts | None) -> str:
    """What the lines say of the light's code."""
    if check is None:
        return "-"
    verdict = check["verdict"].replace("_", " ")
    return f"{verdict} {check['shift']:+d}" if check["shift"] else verdict
