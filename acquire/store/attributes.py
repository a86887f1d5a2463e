"""Validation of the attributes of a recording's root, once, when it is opened.

Afterwards readers may rely on the attributes' types and limits, whatever wrote them; for facts that no reader
interprets (the configuration, the scene) only the type is checked. Recordings of all versions of this format
pass. This is plain Python because lists of recordings are read with it: importing a modelling library would
take longer than reading all of them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from acquire.text import shown

if TYPE_CHECKING:
    from collections.abc import Callable

    Check = Callable[[Any], None]
    """Raises `_WrongError` for a value that is not valid."""

MOST_LINES = 2**62  # the sum of a first line and a count still fits the 64 bits of tables and arrays


class _WrongError(ValueError):
    """``what`` is wrong, and ``where`` in the attributes."""

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
    """Accept any value: it is only shown."""


def _whole(low: int, high: int) -> Check:
    # `type`, not isinstance: JSON's true is an int to Python, and would pass as 1.
    return lambda value: _check(
        type(value) is int and low <= value <= high, value, f"a whole number from {low} to {high}"
    )


def _number(low: float = -math.inf, *, above: bool = False) -> Check:
    """Return a check for a finite number of at least ``low``, or ``above`` it."""
    limit = "" if low == -math.inf else f" above {low:g}" if above else f" from {low:g} on"

    def check(value: Any) -> None:
        fits = type(value) in (int, float) and math.isfinite(value)
        _check(fits and (value > low if above else value >= low), value, f"a finite number{limit}")

    return check


def _maybe(of: Check) -> Check:
    return lambda value: None if value is None else of(value)


def _each(of: Check) -> Check:
    """Return a check for a list of such values."""

    def check(value: Any) -> None:
        _check(isinstance(value, list), value, "a list")
        for number, one in enumerate(value):
            _at(str(number), of, one)

    return check


def _table(of: Check) -> Check:
    """Return a check for a JSON object with such values only."""

    def check(value: Any) -> None:
        _object(value)
        for key, one in value.items():
            _at(key, of, one)

    return check


def _record(required: dict[str, Check], optional: dict[str, Check] | None = None) -> Check:
    """Return a check for a JSON object with these values, and perhaps others."""

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
    """Check a name in the same directory."""
    odd = not isinstance(value, str) or value in ("", ".", "..") or "/" in value or "\0" in value
    _check(not odd, value, "a name")


def _stretch(value: Any) -> None:
    """Check a first line and a count."""
    _each(_COUNT)(value)
    _check(len(value) == 2, value, "a first line and a count")


def _hold(value: Any) -> None:
    """Check a first line, a count and a reason."""
    fits = isinstance(value, list) and [type(one) for one in value] == [int, int, str] and min(value[:2]) >= 0
    _check(fits, value, "a first line, a count and a reason")


def _book(value: Any) -> None:
    """Check an arm's ledger: lines stored, and missing by cause. Anything but an object passes."""
    if isinstance(value, dict):
        _record({}, {"stored": _maybe(_COUNT), "missing": _table(_COUNT)})(value)


def _durability(value: Any) -> None:
    """Check the durability: empty, or the lines that can be lost."""
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
        # S is limited by the code of a line, which is one byte.
        "geometry": _record(
            {"stages": _SIZE, "substeps": _whole(1, 8), "pixels": _SIZE}, {"fibre": _maybe(_FIBRE)}
        ),
        "trigger": _record({"line_period_ticks": _RATE}),
        "clock": _record({"clock_hz": _RATE, "utc_ns_at_tick_0": _SIGNED, "uncertainty_ns": _SIGNED}),
        "code": _object,
        "cameras": _record({"a": _CAMERA, "b": _CAMERA}),
        "ledger": _record({}, {"a": _book, "b": _book, "tainted_by": _table(_number(0))}),
        "versions": _record({"acquire": _text}),
    },
    {
        "config": _object,
        "calibration": _maybe(_record({}, {"steps": _table(_object)})),
        "imported": _maybe(_record({"files": _table(_object), "unknown": _each(_text)})),
        "host": _table(_text),
        "durability": _durability,
        "plugins": _each(_record({"kind": _text, "name": _text, "distribution": _text, "version": _text})),
        "simulated": _truth,
        "dropped": _each(_stretch),
        "holds": _each(_hold),
        "segments": _each(_name),
        "segment": _maybe(_SEGMENT),
    },
)


def segment_of(attributes: dict[str, Any]) -> tuple[str, int] | None:
    """Return the name of the recording that this segment continues, and its number; None if it is not one."""
    # Checked here: searches for segments read roots that nothing has checked as a whole.
    segment: Any = attributes.get("segment")
    try:
        _SEGMENT(segment)
    except _WrongError:
        return None
    return segment["of"], segment["number"]


def upload_target(attributes: dict[str, Any]) -> str | None:
    """Return the URL to which the rig copies its recordings, according to its configuration, or None."""
    # Step by step: this reads roots that nothing has checked.
    found: Any = attributes
    for key in ("config", "recording", "upload_to"):
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, str) else None


def size_limit_bytes(attributes: dict[str, Any]) -> float | None:
    """Return the size to which retention keeps a recording, according to its configuration, or None."""
    found: Any = attributes
    for key in ("config", "recording", "retention", "max_gb"):
        found = found.get(key) if isinstance(found, dict) else None
    return found * 1e9 if type(found) in (int, float) and 0 < found < math.inf else None


def check_attributes(attributes: dict[str, Any]) -> None:
    """Raise ValueError, stating the first fault, unless these are valid attributes of a recording."""
    _ROOT(attributes)
