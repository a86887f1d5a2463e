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


class JobFacts(Message):
    """A job and what became of it."""

    id: int
    kind: str
    recording: Text
    first_line: int
    lines: int
    state: Literal["waiting", "running", "done", "failed", "stopped"]
    text: Text = Field(default="", description="how far it is, or why it failed")
    result: Text | None = Field(default=None, description="name of what it made")
