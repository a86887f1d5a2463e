"""What a recording's root must say for a reader to believe it: checked once, when it is opened.

Whatever wrote the attributes, readers may rely on their kinds and limits afterwards; facts that no reader
takes apart (the configuration, the scene) are only demanded to be of the right kind. Recordings of all
versions of this format pass.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

MOST_LINES = 2**62

Count = Annotated[int, Field(ge=0, le=MOST_LINES)]
Whole = Annotated[int, Field(ge=-(2**63), le=2**63)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def _a_name(text: str) -> str:
    """Of something in the same directory."""
    if text in ("", ".", "..") or "/" in text or "\0" in text:
        raise ValueError("not a name")
    return text


def _a_hold(values: list[Any]) -> list[Any]:
    """First line, count, and why."""
    if [type(value) for value in values] != [int, int, str] or min(values[:2]) < 0:
        raise ValueError("not a first line, a count and a reason")
    return values


Name = Annotated[str, AfterValidator(_a_name)]


class _Facts(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")


class _Geometry(_Facts):
    stages: Annotated[int, Field(ge=1, le=2**16)]
    substeps: Annotated[int, Field(ge=1, le=8)]
    pixels: Annotated[int, Field(ge=1, le=2**16)]


class _Trigger(_Facts):
    line_period_ticks: Annotated[int, Field(ge=1, le=2**48)]


class _Clock(_Facts):
    clock_hz: Annotated[int, Field(ge=1, le=2**48)]
    utc_ns_at_tick_0: Whole
    uncertainty_ns: Whole


class _Camera(_Facts):
    white_dn: Positive
    black_level_dn: Annotated[float, Field(allow_inf_nan=False)]
    responsivity_dn: Positive
    dn_per_electron: Positive | None = None
    read_noise_e: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None


class _Cameras(_Facts):
    a: _Camera
    b: _Camera


class _Book(_Facts):
    stored: Count | None = None
    missing: dict[str, Count] = {}


def _a_book(value: Any) -> Any:
    """Of an arm: lines stored, and missing by cause; a ledger may tell something else instead."""
    if isinstance(value, dict):
        _Book.model_validate(value)
    return value


class _Ledger(_Facts):
    a: Annotated[Any, AfterValidator(_a_book)] = None
    b: Annotated[Any, AfterValidator(_a_book)] = None


class _Outage(_Facts):
    after_line: Whole
    lines: Whole | None
    cause: str


class _Segment(_Facts):
    number: Annotated[int, Field(ge=2, le=2**31)]
    of: Name
    outage: _Outage


class _Durability(_Facts):
    fsync: str
    kill_lines: Count
    power_lines: Count | None


class _Versions(_Facts):
    acquire: str


class _Imported(_Facts):
    files: dict[str, dict[str, Any]]
    unknown: list[str]


class _Root(_Facts):
    state: Literal["recording", "sealed"]
    run_id: str
    run_condition: str | None
    end_reason: str | None
    layout: str
    first_line: Count
    geometry: _Geometry
    trigger: _Trigger
    clock: _Clock
    code: dict[str, Any]
    cameras: _Cameras
    ledger: _Ledger
    versions: _Versions
    config: dict[str, Any] = {}
    calibration: dict[str, Any] | None = None
    imported: _Imported | None = None
    host: dict[str, str] = {}
    durability: _Durability | Annotated[dict[str, Any], Field(max_length=0)] = {}
    simulated: bool = False
    dropped: list[Annotated[list[Count], Field(min_length=2, max_length=2)]] = []
    holds: list[Annotated[list[Any], AfterValidator(_a_hold)]] = []
    segments: list[Name] = []
    segment: _Segment | None = None


def segment_of(attributes: dict[str, Any]) -> tuple[str, int] | None:
    """Name of the first recording that this one continues, and its number; None where it continues none."""
    try:
        segment = _Segment.model_validate(attributes.get("segment"))
    except ValidationError:
        return None
    return segment.of, segment.number


def upload_target(attributes: dict[str, Any]) -> str | None:
    """Where the rig that recorded it copies its recordings, as far as it says so."""
    found: Any = attributes
    for key in ("config", "recording", "upload_to"):
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, str) else None


def check_attributes(attributes: dict[str, Any]) -> None:
    """Raise ValueError, with the first thing that is wrong, unless they are a recording's."""
    try:
        _Root.model_validate(attributes)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{where}: {first['msg'][0].lower()}{first['msg'][1:]}") from None
