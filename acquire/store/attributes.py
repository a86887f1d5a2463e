"""What a recording's root must say for a reader to believe it: checked once, when it is opened.

Whatever wrote the attributes, readers may rely on their kinds and limits afterwards; facts that no reader
takes apart (the configuration, the scene) are only demanded to be of the right kind. Recordings of all
versions of this format pass. A list of recordings is read by this, too: a library of models would take
longer to load than all of them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from acquire.text import shown

if TYPE_CHECKING:
    from collections.abc import Callable

    Check = Callable[[Any], None]
    """Raises `_WrongError` for what a value must not be."""

MOST_LINES = 2**62


class _WrongError(ValueError):
    """``where`` in the attributes something is wrong, and what."""

    def __init__(self, what: str, *where: str) -> None:
        super().__init__(f"{'.'.join(where)}: {what}" if where else what)
        self.what, self.where = what, where


def _check(fits: bool, value: Any, expected: str) -> None:
    if not fits:
        raise _WrongError(f"{shown(value)} is not {expected}")


def _text(value: Any) -> None:
    _check(isinstance(value, str), value, "a text")


def _truth(value: Any) -> None:
    _check(isinstance(value, bool), value, "true or false")


def _object(value: Any) -> None:
    _check(isinstance(value, dict), value, "a JSON object")


def _anything(value: Any) -> None:
    """What is only asked for where it is shown."""


def _whole(low: int, high: int) -> Check:
    return lambda value: _check(
        type(value) is int and low <= value <= high, value, f"a whole number from {low} to {high}"
    )


def _number(low: float = -math.inf, *, above: bool = False) -> Check:
    """A finite number of at least ``low``, or ``above`` it."""
    limit = "" if low == -math.inf else f" above {low:g}" if above else f" from {low:g} on"

    def check(value: Any) -> None:
        fits = type(value) in (int, float) and math.isfinite(value)
        _check(fits and (value > low if above else value >= low), value, f"a finite number{limit}")

    return check


def _maybe(of: Check) -> Check:
    return lambda value: None if value is None else of(value)


def _each(of: Check) -> Check:
    """A list of such values."""

    def check(value: Any) -> None:
        _check(isinstance(value, list), value, "a list")
        for number, one in enumerate(value):
            _at(str(number), of, one)

    return check


def _table(of: Check) -> Check:
    """A JSON object, all values of which are such."""

    def check(value: Any) -> None:
        _object(value)
        for key, one in value.items():
            _at(key, of, one)

    return check


def _record(required: dict[str, Check], optional: dict[str, Check] | None = None) -> Check:
    """A JSON object with these values, and perhaps others."""

    def check(value: Any) -> None:
        _object(value)
        for key, of in required.items():
            if key not in value:
                raise _WrongError("it is missing", key)
            _at(key, of, value[key])
        for key, of in (optional or {}).items():
            if key in value:
                _at(key, of, value[key])

    return check


def _at(key: str, of: Check, value: Any) -> None:
    try:
        of(value)
    except _WrongError as error:
        raise _WrongError(error.what, key, *error.where) from None


def _name(value: Any) -> None:
    """Of something in the same directory."""
    odd = not isinstance(value, str) or value in ("", ".", "..") or "/" in value or "\0" in value
    _check(not odd, value, "a name")


def _stretch(value: Any) -> None:
    """First line and count."""
    _each(_COUNT)(value)
    _check(len(value) == 2, value, "a first line and a count")


def _hold(value: Any) -> None:
    """First line, count, and why."""
    fits = isinstance(value, list) and [type(one) for one in value] == [int, int, str] and min(value[:2]) >= 0
    _check(fits, value, "a first line, a count and a reason")


def _book(value: Any) -> None:
    """Of an arm: lines stored, and missing by cause; a ledger may tell something else instead."""
    if isinstance(value, dict):
        _record({}, {"stored": _maybe(_COUNT), "missing": _table(_COUNT)})(value)


def _durability(value: Any) -> None:
    """Nothing, or what can be lost."""
    if value != {}:
        _record({"fsync": _text, "kill_lines": _COUNT, "power_lines": _maybe(_COUNT)})(value)


_COUNT = _whole(0, MOST_LINES)
_SIGNED = _whole(-(2**63), 2**63)
_SIZE = _whole(1, 2**16)
_RATE = _whole(1, 2**48)
_POSITIVE = _number(0, above=True)
_CAMERA = _record(
    {"white_dn": _POSITIVE, "black_level_dn": _number(), "responsivity_dn": _POSITIVE},
    {"dn_per_electron": _maybe(_POSITIVE), "read_noise_e": _maybe(_number(0))},
)
_FIBRE = _record(
    {"rows": _SIZE, "columns": _SIZE, "bands": _record({"a": _each(_COUNT), "b": _each(_COUNT)})}
)
_SEGMENT = _record(
    {
        "number": _whole(2, 2**31),
        "of": _name,
        "outage": _record({"after_line": _SIGNED, "lines": _maybe(_SIGNED), "cause": _text}),
    }
)
_ROOT = _record(
    {
        "state": lambda value: _check(value in ("recording", "sealed"), value, "'recording' or 'sealed'"),
        "run_id": _text,
        "run_condition": _maybe(_text),
        "end_reason": _maybe(_text),
        "layout": _text,
        "first_line": _COUNT,
        "geometry": _record(
            {"stages": _SIZE, "substeps": _whole(1, 8), "pixels": _SIZE}, {"fibre": _maybe(_FIBRE)}
        ),
        "trigger": _record({"line_period_ticks": _RATE}),
        "clock": _record({"clock_hz": _RATE, "utc_ns_at_tick_0": _SIGNED, "uncertainty_ns": _SIGNED}),
        "code": _object,
        "cameras": _record({"a": _CAMERA, "b": _CAMERA}),
        "ledger": _record({}, {"a": _book, "b": _book}),
        "versions": _record({"acquire": _text}),
    },
    {
        "config": _object,
        "calibration": _maybe(_object),
        "imported": _maybe(_record({"files": _table(_object), "unknown": _each(_text)})),
        "host": _table(_text),
        "durability": _durability,
        "simulated": _truth,
        "dropped": _each(_stretch),
        "holds": _each(_hold),
        "segments": _each(_name),
        "segment": _maybe(_SEGMENT),
    },
)


def segment_of(attributes: dict[str, Any]) -> tuple[str, int] | None:
    """Name of the first recording that this one continues, and its number; None where it continues none."""
    segment: Any = attributes.get("segment")
    try:
        _SEGMENT(segment)
    except _WrongError:
        return None
    return segment["of"], segment["number"]


def upload_target(attributes: dict[str, Any]) -> str | None:
    """Where the rig that recorded it copies its recordings, as far as it says so."""
    found: Any = attributes
    for key in ("config", "recording", "upload_to"):
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, str) else None


def check_attributes(attributes: dict[str, Any]) -> None:
    """Raise ValueError, with the first thing that is wrong, unless they are a recording's."""
    _ROOT(attributes)
