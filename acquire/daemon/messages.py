"""What travels over the control socket: requests, the status, and errors as JSON.

The daemon and its clients share these models; the API description is made from them.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, field_validator, model_validator

from acquire import errors
from acquire.daemon.states import State
from acquire.errors import AcquireError, DeviceError, StateError, UsageError
from acquire.text import visible


def _on_the_wire(text: object) -> str:
    return visible(text, lines=True)


Text = Annotated[str, PlainSerializer(_on_the_wire, return_type=str, when_used="json")]
"""Whatever is in it, such as the name of a file that is not UTF-8: in JSON it is readable, and harmless."""
Place = Annotated[Path, PlainSerializer(_on_the_wire, return_type=str, when_used="json")]
LONGEST_NAME = 200
"""Bytes of a recording's name: what lies beside it, such as a further segment, has a longer one."""
LONGEST_MARK = 400
"""Characters."""


class Message(BaseModel):
    """Unknown keys are refused; values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


LightCode = Literal["rig", "dark", "steady"]
"""What the light follows in a run: the rig's code, or off, or on, as calibration asks for."""


class TriggerDelays(Message):
    """When light and lines start beside each other, in ticks of the trigger's clock."""

    light_lead: int = Field(ge=0, le=255, description="by which light precedes its sub-step")
    a: int = Field(ge=0, lt=2**24, description="from a line's start to camera A's pulse")
    b: int = Field(ge=0, lt=2**24)


class TriggerWindow(Message):
    """When the light of a lit sub-step is on, in ticks of the trigger from the sub-step's beginning."""

    open: int = Field(ge=0, lt=2**24)
    close: int = Field(ge=1, lt=2**24)


class ArmRequest(Message):
    """How to arm."""

    code: LightCode = Field(
        default="rig",
        description="what the light follows: the rig's code; 'dark': it stays off; 'steady': it stays on",
    )

    calibration: Literal["rig", "none"] = Field(
        default="rig", description="'none': recordings get no copy of the one that the rig names"
    )
    delays: TriggerDelays | None = Field(
        default=None, description="in place of the rig's, as a search for them asks"
    )
    window: TriggerWindow | None = Field(
        default=None, description="of the light, in place of the rig's, as a ramp of light asks"
    )
    force: bool = Field(
        default=False,
        strict=True,
        description="even where the host is too slow for the configured rate, or uploads are refused",
    )


class StartRequest(Message):
    """Where to record, and how much."""

    path: Path | None = Field(
        default=None,
        description="absolute path of the new recording; absent: named after rig and time in the "
        "configured directory",
    )
    lines: int | None = Field(
        default=None, strict=True, ge=1, le=2**53, description="line budget; absent: until stop"
    )
    duration_s: float | None = Field(
        default=None,
        strict=True,
        gt=0,
        le=1e9,
        allow_inf_nan=False,
        description="budget in seconds instead of lines",
    )
    pre_s: float = Field(
        default=0.0,
        strict=True,
        ge=0,
        le=1e6,
        allow_inf_nan=False,
        description="of it, from before the request",
    )
    post_s: float | None = Field(
        default=None,
        strict=True,
        gt=0,
        le=1e9,
        allow_inf_nan=False,
        description="to record after the request, as budget",
    )
    resume: bool = Field(
        default=False,
        strict=True,
        description="path is a sealed recording: go on with it in a further segment beside it",
    )

    @model_validator(mode="after")
    def _one_budget(self) -> StartRequest:
        given = [name for name in ("lines", "duration_s", "post_s") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} are ways to say the same: give one")
        if self.duration_s is not None and self.pre_s >= self.duration_s:
            raise ValueError("pre_s is a part of duration_s: give a smaller one")
        if self.resume and self.path is None:
            raise ValueError("resume needs the path of the recording to go on with")
        if self.path is not None and not self.path.is_absolute():
            raise ValueError(f"path {str(self.path)!r} is not absolute: the daemon has another directory")
        return self

    @field_validator("path")
    @classmethod
    def _can_be_a_name(cls, path: Path | None) -> Path | None:
        text = str(path)
        if "\0" in text or text != text.encode(errors="replace").decode():
            raise ValueError(f"path {text!r} is not UTF-8, or has a NUL")
        if path is not None and len(path.name.encode()) > LONGEST_NAME:
            raise ValueError(f"path ends in a name that is too long: at most {LONGEST_NAME} bytes")
        return path


class MarkRequest(Message):
    """What happens now, in the operator's words."""

    text: str = Field(
        default="", max_length=LONGEST_MARK, description="one line, as long as a sentence or two"
    )


class RingStatus(Message):
    """Fill of the ring between a camera and the recorder, in slots."""

    slots: int
    fill: int
    peak: int
    drops: int = Field(description="blocks that found no free slot")
    history: int = Field(default=0, description="slots from the past that a recording can begin with")


class LedgerStatus(Message):
    """Every pulse since arm: issued = preroll + stored + discarded + lost + waiting + pending."""

    issued: int = Field(description="by the trigger, as far as tags and lines tell")
    preroll: int = Field(description="exposed before the run's start")
    stored: int = Field(description="in recordings; a line that several hold counts once")
    discarded: int = Field(description="in none: nobody asked for them, or the recording had ended before")
    lost: dict[str, int] = Field(description="cause → lines")
    waiting: int = Field(description="in the ring")
    pending: int = Field(
        description="in camera or driver; once idle: what was there when the trigger stopped, of no recording"
    )
    balanced: bool


class CheckStatus(Message):
    """What the lines say of the light's code."""

    verdict: Text = Field(description="verified, shifted, inverted, wrong_code, dark or unknown")
    shift: int = Field(description="sub-steps by which the lines are late")
    checked_line: int = Field(description="the line after the last that was looked at")
    lapped: int = Field(description="ring slots that came and went unseen by the check")


class ArmStatus(Message):
    """One arm since it was armed: what its camera delivered and what became of it, in lines."""

    delivered: int = Field(description="by the camera, the preroll included")
    preroll: int = Field(description="exposed before the run's start, discarded")
    discarded: int = Field(
        default=0,
        description="in no recording; once idle, delivered = preroll + discarded + lost.ring_full + "
        "ledger.stored",
    )
    lost: dict[str, int] = Field(description="cause → lines")
    recorded: int = Field(description="rows of the latest recording")
    missing: int = Field(description="those of them that hold no line")
    rate_hz: float = Field(description="lines per second over the last five seconds")
    saturated: int = Field(default=0, description="lines with a saturated pixel, of those delivered")
    saturated_part: float = Field(default=0.0, description="of the lines of the last five seconds, 0 to 1")
    drift_ppb: int = Field(
        default=0, description="by which the camera's clock is faster than the trigger's, if it tells time"
    )
    ring: RingStatus
    ledger: LedgerStatus | None = None
    check: CheckStatus | None = Field(default=None, description="null: the rig does not check")


class RecordingStatus(Message):
    """The recording being written."""

    path: Place
    first_line: int | None = Field(description="the trigger's number of row 0")
    budget_lines: int | None
    recorded_lines: int = Field(description="rows that both arms have")
    committed_lines: int = Field(description="rows that a reader can see, in both arms")


class LastRecording(Message):
    """The recording that was closed last."""

    path: Place
    lines: int
    condition: Text | None = Field(description="what the lines are worth; null: it could not be sealed")
    end_reason: Text | None


class RecoveryStatus(Message):
    """A recording that its recorder did not seal, and what the daemon made of it."""

    path: Place
    state: Literal["waiting", "recovered", "left", "failed", "gone"] = Field(
        description="waiting for its turn or a lock; sealed; not to be touched by this daemon, or not a "
        "recording at all; could not be; not there, or nothing was ever recorded to it"
    )
    lines: int | None = Field(default=None, description="of each arm that a reader finds")
    condition: Text | None = Field(default=None, description="what the lines are worth, once it is recovered")
    text: Text = Field(default="", description="how it came to that; once it is recovered, its end reason")


class UploadStatus(Message):
    """A recording on its way to `recording.upload_to`."""

    path: Place
    url: Text
    state: Literal["waiting", "copying", "copied", "refused", "gone"] = Field(
        description="waiting for its turn, its end or the store; under way, while it grows or after; whole "
        "there; something else is there; deleted here before it was copied"
    )
    lines: int = Field(default=0, description="of each arm that are there")
    waiting_lines: int | None = Field(default=None, description="that a reader finds here only")
    bytes: int = Field(default=0, description="sent since the copy was begun or gone on with")
    error: Text = Field(default="", description="why the last try failed; it is tried again while waiting")
    hint: Text = ""


class CapacityStatus(Message):
    """What this host sustains, as measured before the run was armed; line rates of both arms."""

    line_rate_hz: float = Field(description="configured")
    sustained_hz: float | None = Field(default=None, description="null: could not be measured")
    codec: Text | None = Field(default=None, description="that was measured, chosen where the rig says auto")
    limit: Text | None = Field(default=None, description="what allows least")
    limits_hz: dict[str, float] = Field(default={}, description="ring, codec, recorder, processors")
    warning: Text | None = None


class TriggerStatus(Message):
    """The instrument's clock, since it was armed."""

    clock_hz: int
    uncertainty_ns: int = Field(description="of its relation to UTC")
    pulses: int = Field(description="lines that it has begun")
    silent_s: float = Field(description="since it last sent a tag or an answer")
    answers: bool = Field(description="it was not silent for longer than it should be")


class DiskStatus(Message):
    """Room for recordings that have no path of their own."""

    directory: Place
    free_bytes: int
    reserve_bytes: int = Field(description="of it, that no recording takes")
    bytes_per_s: float = Field(
        description="at which it fills, over the last minute of a recording; else what the cameras would "
        "give, not compressed"
    )
    seconds_to_full: float = Field(description="at that rate, to the reserve")


class TroubleStatus(Message):
    """A failure that nobody foresaw, in something that nobody asked for; the service goes on."""

    text: Text = Field(description="where, and what")
    times: int
    last: datetime


class CalibrationStatus(Message):
    """What recordings of this run carry of a calibration."""

    path: Place | None = Field(description="of the calibration that the rig names")
    carried: bool = Field(description="recordings get a copy")
    text: Text


class Status(Message):
    """What the daemon is doing, and how well."""

    state: State
    since: datetime
    possible: list[Text] = Field(description="commands that the state allows")
    busy: Text | None = Field(
        description="the command being carried out, and after a colon what it is waiting for"
    )
    name: Text = Field(description="of the rig")
    version: Text
    pid: int
    uptime_s: float
    run_id: Text | None
    recording: RecordingStatus | None
    arms: dict[str, ArmStatus]
    last: LastRecording | None
    waiting: Text | None = Field(
        default=None, description="what takes longer than it should, and how long that can be borne, in words"
    )
    fault: Text | None
    trigger: TriggerStatus | None = Field(default=None, description="null: not armed")
    disk: DiskStatus | None = Field(default=None, description="null: it has not been seen yet")
    capacity: CapacityStatus | None = None
    calibration: CalibrationStatus | None = Field(
        default=None, description="null: not armed, or the rig names none"
    )
    processes: dict[str, int] = Field(default={}, description="of the run: name → process number")
    recoveries: list[RecoveryStatus] = Field(
        default=[], description="the latest recordings that were not sealed"
    )
    uploads: list[UploadStatus] = Field(
        default=[],
        description="recordings that are not copied to where the rig wants them, and the latest that are",
    )
    uploads_left: int = Field(default=0, description="recordings that are not copied, listed or not")
    upload_warning: Text | None = Field(default=None, description="why copies may have to wait")
    troubles: list[TroubleStatus] = Field(default=[], description="unforeseen failures, the latest last")


class ErrorMessage(Message):
    """An AcquireError on the wire."""

    error: Text = Field(description="name of the class in acquire.errors")
    message: Text
    possible: Text = ""
    hint: Text = ""
    exit_code: int

    @classmethod
    def of(cls, error: AcquireError) -> ErrorMessage:
        return cls(**error.to_dict())

    def rebuild(self) -> AcquireError:
        """The error again, of its own class where this version knows it."""
        known = getattr(errors, self.error, None)
        if not (isinstance(known, type) and issubclass(known, AcquireError)):
            known = AcquireError
        return known(self.message, possible=self.possible, hint=self.hint)


HTTP_STATUS: tuple[tuple[type[AcquireError], int], ...] = (
    (UsageError, 422),
    (StateError, 409),
    (DeviceError, 503),
    (AcquireError, 500),
)
"""The first class that fits decides."""


def http_status(error: AcquireError) -> int:
    return next(status for kind, status in HTTP_STATUS if isinstance(error, kind))


def fault_error(fault: str | None) -> DeviceError:
    """What a command raises that ends in a fault."""
    return DeviceError(f"fault: {fault}", hint="acquire disarm, then look at the device")


def error_body(error: AcquireError) -> dict[str, Any]:
    return ErrorMessage.of(error).model_dump(mode="json")
