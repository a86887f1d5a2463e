"""What the page's own routes tell and take, beside those of the daemon's API."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from acquire.daemon.messages import Message, Text

MOST_LINES = 2**53


class SessionRequest(Message):
    """A token for a cookie."""

    token: str = Field(max_length=256)


class Session(Message):
    """Who is asking."""

    role: Literal["operator", "viewer"]


class RecordingFacts(Message):
    """A recording at a glance."""

    name: Text
    run_id: Text | None = None
    state: Text = Field(default="", description="recording, or sealed; empty where it cannot be read")
    condition: Text | None = None
    end_reason: Text | None = None
    first_line: int = 0
    lines: int = 0
    duration_s: float = 0.0
    line_rate_hz: float = 0.0
    bytes: int = 0
    start_ns: int | None = None
    lost_lines: dict[str, int] = Field(default={})
    events: int = 0
    held: bool = Field(default=False, description="some of its lines are kept from retention")
    uploaded: Text | None = Field(default=None, description="where it is copied to")
    damage: Text | None = None
    error: Text | None = Field(default=None, description="why it cannot be read")


class EventFacts(Message):
    """On the recording's time line."""

    kind: Text
    line: int
    text: Text


class GapFacts(Message):
    """Lines that were lost."""

    arm: str
    first_line: int
    count: int
    cause: Text


class HoldFacts(Message):
    """Lines that are kept."""

    first_line: int
    count: int
    why: Text


class RecordingDetail(RecordingFacts):
    """And what happened in it."""

    event_list: list[EventFacts] = Field(default=[])
    gap_list: list[GapFacts] = Field(default=[])
    hold_list: list[HoldFacts] = Field(default=[])


class HoldRequest(Message):
    """Lines to be kept."""

    first_line: int = Field(strict=True, ge=0, le=MOST_LINES)
    lines: int = Field(strict=True, ge=1, le=MOST_LINES)
    why: str = Field(default="", max_length=200)


class VideoFacts(Message):
    """A reconstructed video."""

    name: Text
    frames: int = 0
    rows: int = 0
    columns: int = 0
    interval_ns: float = 0.0
    start_ns: int | None = None
    trusted: tuple[int, int] | None = Field(
        default=None, description="the first frame and the one after the last that were sampled in full"
    )
    low: float = Field(default=0.0, description="shown black")
    high: float = Field(default=1.0, description="shown white")
    error: Text | None = None


class JobRequest(Message):
    """Work on a recording that takes its time."""

    kind: Literal["reconstruct", "preview", "cut"]
    recording: str = Field(max_length=255)
    first_line: int = Field(strict=True, ge=0, le=MOST_LINES)
    lines: int = Field(strict=True, ge=1, le=2**24)
    spatial_merge: int = Field(default=3, strict=True, ge=1, le=64)
    temporal_merge: int = Field(default=1, strict=True, ge=1, le=4096)
    preset: Literal["fast", "balanced", "best"] = "balanced"


class CalibrationRequest(Message):
    """A step of the calibration, with what it needs in place already."""

    step: str = Field(max_length=64)
    lines: int | None = Field(
        default=None, strict=True, ge=1, le=2**20, description="of each recording; absent: as many as usual"
    )


class JobFacts(Message):
    """A job and what became of it."""

    id: int
    kind: Literal["reconstruct", "preview", "cut", "calibrate"]
    recording: Text = Field(default="", description="empty: it makes recordings of its own")
    step: Text | None = Field(default=None, description="of the calibration")
    first_line: int = 0
    lines: int | None = Field(default=None, description="absent: as many as it takes")
    state: Literal["waiting", "running", "done", "failed", "stopped"]
    text: Text = Field(default="", description="what it does, or why it failed")
    done: float | None = Field(default=None, description="so much of it")
    total: float | None = Field(default=None, description="of so much")
    result: Text | None = Field(default=None, description="name of what it made")


class FindingFacts(Message):
    """What one step of a calibration found, in words."""

    name: Text
    made: Text
    lines: int
    facts: dict[str, Text] = Field(description="what → value and uncertainty")
    warnings: list[Text]


class StepFacts(Message):
    """A step: what is to be done before it, and what it found the last time."""

    name: str
    prepare: str
    lines: int | None = Field(description="of each recording, as usual; null: as many as it takes")
    least_lines: int
    after: str = Field(description="the step that it needs; empty: none")
    found: list[FindingFacts]


class CalibrationFacts(Message):
    """The calibration of this instrument."""

    path: Text
    named: bool = Field(description="by the rig: recordings get a copy of it")
    error: Text | None = Field(default=None, description="why it cannot be read")
    steps: list[StepFacts]
