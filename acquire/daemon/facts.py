"""What the API tells besides the status: news, health, version, setup, and where the lines pass."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from acquire.daemon.messages import Message, Place, Text
from acquire.daemon.states import State

API_VERSION = 1
"""Raised by what an older client could not understand."""
NewsKind = Literal[
    "state",
    "mark",
    "input",
    "threshold",
    "loss",
    "verdict",
    "segment",
    "waiting",
    "recovery",
    "upload",
    "disk",
    "trouble",
    "reload",
    "event",
    "missed",
]
Level = Literal["info", "warning", "error"]


class News(Message):
    """Something that happened. ``id`` is what a client that was away gives back to hear what came after."""

    id: str = Field(description="of this daemon's life, and a number that rises")
    time: datetime
    kind: NewsKind = Field(
        description="'missed': what happened before is not known any more, since the daemon was started anew "
        "or keeps only the latest; 'event': of a kind that this version does not know"
    )
    level: Level = "info"
    text: Text
    state: State = Field(description="of the daemon, after it")
    arm: str | None = None
    line: int | None = Field(default=None, description="the trigger's number")
    lines: int | None = Field(default=None, description="'loss': lines lost since the last news of it")
    path: Place | None = None


class HealthCheck(Message):
    """One thing that is judged, with the threshold that judges it."""

    name: str
    level: Literal["good", "unknown", "warning", "bad"]
    text: Text
    value: float | None = None
    unit: str = ""
    limit: str = Field(default="", description="what is good and what is bad, in words")


class Health(Message):
    """The glance: one word, one sentence, and what they follow from."""

    level: Literal["idle", "good", "degraded", "lost", "fault"] = Field(
        description="degraded: nothing is lost yet; lost: lines were, since the instrument was armed"
    )
    sentence: Text
    lost_lines: int = Field(description="since the instrument was armed, both arms")
    checks: list[HealthCheck]


class Version(Message):
    """Who answers."""

    acquire: str
    api: int = API_VERSION
    name: Text = Field(description="of the rig")
    pid: int
    python: str


class Setup(Message):
    """The resolved configuration, and how it differs from the defaults."""

    name: Text
    file: Text = Field(description="that it was read from; empty: not from a file")
    config: dict[str, Any]
    changed: dict[str, Any] = Field(description="dotted key → value, where it is not the default")
    line_rate_hz: float = Field(description="as lines pass here: simulated time may run faster")
    line_period_ns: float = Field(description="by the trigger's clock")
    white_dn: int
    black_dn: dict[str, float]
    history_s: float = Field(description="of lines from the past that the rings hold")
    versions: dict[str, str] = Field(description="of the libraries on the way from camera to disk")


class ChangedKey(Message):
    """A key of the configuration that has another value since the file was read anew."""

    key: Text = Field(description="dotted")
    old: Any
    new: Any
    holds: Text = Field(description="when: at once, from the next recording on, when the service starts next")


class Reloaded(Message):
    """What a reload has changed; one that is refused changes nothing."""

    file: Text = Field(description="that was read")
    changed: list[ChangedKey] = Field(description="empty: the file says what it said before")


class RingPlace(Message):
    """The ring of one arm: memory that a process of the same user can map and read, never write."""

    path: str = Field(description="of the memory, while the daemon lives")
    slots: int
    rows: int
    width: int
    dtype: str
    observers: int
    reserve: int


class Rings(Message):
    """Where the lines pass; empty while nothing is armed."""

    run_id: str | None
    arms: dict[str, RingPlace]
