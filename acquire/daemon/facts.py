"""Facts that the API provides besides the status: news, health, version, setup, and the rings' places."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from acquire.daemon.messages import Message, Place, Text
from acquire.daemon.states import State

API_VERSION = 1
"""Incremented by changes that an older client could not understand."""
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
    """Something that happened. After a reconnection a client sends the latest ``id`` to get later news."""

    id: str = Field(description="identifies this daemon process, with a rising number")
    time: datetime
    kind: NewsKind = Field(
        description="'missed': earlier news are not available any more, since the daemon was restarted or "
        "keeps only the latest; 'event': of a kind that this version does not know"
    )
    level: Level = "info"
    text: Text
    state: State = Field(description="state of the daemon afterwards")
    arm: str | None = None
    line: int | None = Field(default=None, description="the trigger's line number")
    lines: int | None = Field(default=None, description="'loss': lines lost since the last news of it")
    path: Place | None = None


class HealthCheck(Message):
    """One check, with its threshold."""

    name: str
    level: Literal["good", "unknown", "warning", "bad"]
    text: Text
    value: float | None = None
    unit: str = ""
    limit: str = Field(default="", description="the thresholds, in words")


class Health(Message):
    """Health at a glance: one word, one sentence, and the checks behind them."""

    level: Literal["idle", "good", "degraded", "lost", "fault"] = Field(
        description="degraded: nothing is lost yet; lost: lines were lost since the instrument was armed"
    )
    sentence: Text
    lost_lines: int = Field(description="lines lost since the instrument was armed, both arms")
    checks: list[HealthCheck]


class Version(Message):
    """Identity of the daemon."""

    acquire: str
    api: int = API_VERSION
    name: Text = Field(description="name of the rig")
    pid: int
    python: str


class DeviceFacts(Message):
    """A device of the rig, as it described itself when it was armed last; empty: it does not say."""

    device: str = Field(description="trigger, camera a or camera b")
    model: Text = ""
    vendor: Text = ""
    serial: Text = ""
    firmware: Text = ""
    board: Text = Field(default="", description="of a trigger with this project's gateware")
    port: Text = Field(default="", description="where the trigger is connected")
    settings: dict[str, Any] = Field(
        default={},
        description="of a camera: what it reported of that on which its lines depend, such as its gain",
    )


class Setup(Message):
    """The resolved configuration, and how it differs from the defaults."""

    name: Text
    file: Text = Field(description="file that the configuration was read from; empty: none")
    config: dict[str, Any]
    changed: dict[str, Any] = Field(description="dotted key → value that differs from the default")
    line_rate_hz: float = Field(description="rate of the lines here: simulated time may run faster")
    line_period_ns: float = Field(description="line period by the trigger's clock")
    white_dn: int
    black_dn: dict[str, float]
    history_s: float = Field(description="seconds of past lines that the rings hold")
    versions: dict[str, str] = Field(description="versions of the libraries between camera and disk")
    devices: list[DeviceFacts] = Field(
        default=[], description="as armed last; empty: not since the daemon started"
    )


class LogEntry(Message):
    """An entry of the daemon's log, in one line."""

    time: datetime
    level: Text = Field(description="info, warning, error, critical or debug")
    text: Text


class LogTail(Message):
    """The latest entries of the daemon's log, newest last. What looks like a token is left out."""

    entries: list[LogEntry]


class ChangedKey(Message):
    """A key of the configuration with a new value after a reload of the file."""

    key: Text = Field(description="dotted key")
    old: Any
    new: Any
    holds: Text = Field(
        description="when it takes effect: at once, from the next recording on, when the service starts next"
    )


class Reloaded(Message):
    """The changes by a reload; a refused one changes nothing."""

    file: Text = Field(description="file that was read")
    changed: list[ChangedKey] = Field(description="empty: the file has not changed")


class RingPlace(Message):
    """The ring of one arm: memory that a process of the same user can map and read, but not write."""

    path: str = Field(description="path of the memory while the daemon lives")
    slots: int
    rows: int
    width: int
    dtype: str
    observers: int
    reserve: int


class Rings(Message):
    """The memory through which the lines pass; empty while nothing is armed."""

    run_id: str | None
    arms: dict[str, RingPlace]
