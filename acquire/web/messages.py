"""Requests and answers of the page's own routes, in addition to those of the daemon's API."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from acquire.daemon.messages import Message, Text
from acquire.store.retention import LONGEST_WHY

# The largest whole number up to which those of JavaScript are exact.
MOST_LINES = 2**53


class SessionRequest(Message):
    """A token to be exchanged for a cookie."""

    token: str = Field(max_length=256)


class Session(Message):
    """The role of the caller."""

    role: Literal["operator", "viewer"]


class RecordingFacts(Message):
    """Summary of a recording."""

    name: Text
    run_id: Text | None = None
    state: Text = Field(default="", description="recording or sealed; empty if it cannot be read")
    condition: Text | None = None
    end_reason: Text | None = None
    first_line: int = 0
    lines: int = 0
    duration_s: float = 0.0
    line_rate_hz: float = 0.0
    bytes: int = 0
    start_ns: int | None = None
    lost_lines: dict[str, int] | None = Field(default={}, description="null: the gaps cannot be read")
    tainted_by: list[Text] = Field(default=[], description="the reasons to doubt stored lines")
    events: int | None = Field(default=0, description="null: they cannot be read")
    incomplete: list[Text] = Field(default=[], description="what its lists of events and gaps do not have")
    held: bool = Field(default=False, description="some of its lines are protected from retention")
    uploaded: Text | None = Field(default=None, description="URL to which it is copied")
    damage: Text | None = None
    error: Text | None = Field(default=None, description="why it cannot be read")


class EventFacts(Message):
    """An event of a recording."""

    kind: Text
    line: int
    text: Text


class GapFacts(Message):
    """A range of lost lines."""

    arm: str
    first_line: int
    count: int
    cause: Text


class HoldFacts(Message):
    """A range of lines that retention keeps."""

    first_line: int
    count: int
    why: Text


class RecordingDetail(RecordingFacts):
    """A recording with its events, gaps and holds."""

    event_list: list[EventFacts] = Field(default=[])
    gap_list: list[GapFacts] = Field(default=[])
    hold_list: list[HoldFacts] = Field(default=[])


class HoldRequest(Message):
    """A range of lines to protect from retention."""

    first_line: int = Field(strict=True, ge=0, le=MOST_LINES)
    lines: int = Field(strict=True, ge=1, le=MOST_LINES)
    why: str = Field(default="", max_length=LONGEST_WHY)


class VideoFacts(Message):
    """A reconstructed video."""

    name: Text
    frames: int = 0
    rows: int = 0
    columns: int = 0
    interval_ns: float = 0.0
    start_ns: int | None = None
    trusted: tuple[int, int] | None = Field(
        default=None, description="first and end of the frames that were sampled in full"
    )
    low: float = Field(default=0.0, description="value shown as black")
    high: float = Field(default=1.0, description="value shown as white")
    missing: list[tuple[int, int]] = Field(
        default=[], description="first and end of frames of which a file is not there"
    )
    error: Text | None = None


class JobRequest(Message):
    """Long-running work on a recording."""

    kind: Literal["reconstruct", "preview", "cut"]
    # No file system of Linux has names of more than 255 bytes; an escape is of 6 characters.
    recording: str = Field(max_length=6 * 255)
    first_line: int = Field(strict=True, ge=0, le=MOST_LINES)
    lines: int = Field(strict=True, ge=1, le=2**24)
    spatial_merge: int = Field(default=3, strict=True, ge=1, le=64)
    temporal_merge: int = Field(default=1, strict=True, ge=1, le=4096)
    preset: Literal["fast", "balanced", "best"] = "balanced"


class CalibrationRequest(Message):
    """A calibration step to carry out; the target it needs must be in place."""

    step: str = Field(max_length=64)
    lines: int | None = Field(
        default=None, strict=True, ge=1, le=2**20, description="lines of each recording; absent: the default"
    )
    black: bool = Field(
        default=False, description="the target's dark parts send no light, and also show the lens's veil"
    )


class ForgetRequest(Message):
    """Findings to take out of the calibration, those that depend on them included."""

    steps: list[Annotated[str, Field(max_length=64)]] = Field(min_length=1, max_length=64)


class JobFacts(Message):
    """A job and its result."""

    id: int
    kind: Literal["reconstruct", "preview", "cut", "calibrate"]
    recording: Text = Field(default="", description="its input; empty: it makes its own recordings")
    step: Text | None = Field(default=None, description="step of the calibration")
    first_line: int = 0
    lines: int | None = Field(default=None, description="absent: as many as it needs")
    state: Literal["waiting", "running", "done", "failed", "stopped"]
    text: Text = Field(default="", description="its current activity, or why it failed")
    done: float | None = Field(default=None, description="amount of work done")
    total: float | None = Field(default=None, description="total amount of work")
    result: Text | None = Field(default=None, description="name of its result")


class CheckupFinding(Message):
    """A finding about the host: what was examined, its condition, and what to do if it is not good."""

    name: Text
    level: Literal["good", "warning", "bad"]
    text: Text
    todo: Text = ""


class CheckupFacts(Message):
    """The latest examination of the host."""

    examined: datetime | None = Field(default=None, description="when; null: not since the page started")
    running: bool = Field(default=False, description="another examination is running")
    findings: list[CheckupFinding] = Field(default=[])


class FindingFacts(Message):
    """A finding of a calibration step, as text."""

    name: Text
    made: Text
    lines: int
    facts: dict[str, Text] = Field(description="quantity → value and uncertainty")
    warnings: list[Text]
    also: list[Text] = Field(default=[], description="steps that can only be forgotten together with it")
    why: list[Text] = Field(default=[], description="why each of these depends on it")


class StepFacts(Message):
    """A step, with its preparation and its latest findings."""

    name: str
    prepare: str
    lines: int | None = Field(description="default lines of each recording; null: as many as it needs")
    least_lines: int
    after: str = Field(description="the step that must precede it; empty: none")
    black: str = Field(description="what `black` of a request says of the scene; empty: no such choice")
    found: list[FindingFacts]


class CalibrationFacts(Message):
    """The calibration of this instrument."""

    path: Text
    named: bool = Field(description="the rig names it, so that recordings get a copy of it")
    error: Text | None = Field(default=None, description="why it cannot be read")
    steps: list[StepFacts]
