"""Messages on the control socket: requests, the status, and errors as JSON.

The daemon and its clients share these models; the API description is generated from them.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, field_validator, model_validator

from acquire import errors
from acquire.daemon.options import LightCode
from acquire.daemon.states import State
from acquire.errors import (
    AcquireError,
    BusyError,
    DataError,
    DeviceError,
    NoDaemonError,
    StateError,
    UsageError,
)
from acquire.text import visible


def on_the_wire(text: object) -> str:
    """Return a text as it is in JSON."""
    return visible(text, lines=True)


# On the wire only: in this process a text stays what it was.
Text = Annotated[str, PlainSerializer(on_the_wire, return_type=str, when_used="json")]
"""Text that is made readable and harmless in JSON, such as a file name that is not UTF-8."""
Place = Annotated[Path, PlainSerializer(on_the_wire, return_type=str, when_used="json")]
LONGEST_NAME = 200
"""Longest name of a recording in bytes: names derived from it, such as a further segment's, are longer."""
LONGEST_MARK = 400
"""Longest text of a mark, in characters."""
LONGEST_ID = 128
"""Longest id of a request."""


class Message(BaseModel):
    """Unknown keys are refused; values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TriggerDelays(Message):
    """When light and lines start relative to each other, in ticks of the trigger's clock."""

    light_lead: int = Field(ge=0, le=255, description="by which light precedes its sub-step")
    a: int = Field(ge=0, lt=2**24, description="from a line's start to camera A's pulse")
    b: int = Field(ge=0, lt=2**24)


class TriggerWindow(Message):
    """When the light of a lit sub-step is on, in ticks of the trigger from the sub-step's beginning."""

    open: int = Field(ge=0, lt=2**24)
    close: int = Field(ge=1, lt=2**24)


class ArmRequest(Message):
    """Options of arming."""

    code: LightCode = Field(
        default="rig",
        description="what the light follows: the rig's code; 'dark': it stays off; 'steady': it stays on",
    )

    calibration: Literal["rig", "none"] = Field(
        default="rig", description="'none': recordings get no copy of the rig's calibration"
    )
    delays: TriggerDelays | None = Field(
        default=None, description="delays instead of the rig's, for a search of the delays"
    )
    window: TriggerWindow | None = Field(
        default=None, description="window of the light instead of the rig's, for a ramp of light"
    )
    force: bool = Field(
        default=False,
        strict=True,
        description="arm even if the host is too slow for the configured rate, or uploads are refused",
    )


class StartRequest(Message):
    """Where to record, and how much."""

    path: Path | None = Field(
        default=None,
        description="absolute path of the new recording; absent: named after rig and time in the "
        "configured directory",
    )
    # Up to 2**53: browsers do not keep larger integers exactly.
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
        description="seconds of it from before the request",
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
        description="path is a sealed recording: continue it in a further segment next to it",
    )

    @model_validator(mode="after")
    def _one_budget(self) -> StartRequest:
        given = [name for name in ("lines", "duration_s", "post_s") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other: give one")
        if self.duration_s is not None and self.pre_s >= self.duration_s:
            raise ValueError("pre_s must be less than duration_s, which includes it")
        if self.resume and self.path is None:
            raise ValueError("resume needs the path of the recording to continue")
        if self.path is not None and not self.path.is_absolute():
            raise ValueError(f"path {str(self.path)!r} is not absolute: the daemon has another directory")
        return self

    @field_validator("path")
    @classmethod
    def _can_be_a_name(cls, path: Path | None) -> Path | None:
        text = str(path)
        # A surrogate stands for a byte of a name that is not UTF-8, and could not be written to a log or an
        # answer.
        if "\0" in text or text != text.encode(errors="replace").decode():
            raise ValueError(f"path {text!r} is not UTF-8, or has a NUL")
        if path is not None and len(path.name.encode()) > LONGEST_NAME:
            raise ValueError(f"path ends in a name that is too long: at most {LONGEST_NAME} bytes")
        return path


class MarkRequest(Message):
    """A remark on what happens now, in the operator's words."""

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

    issued: int = Field(description="issued by the trigger, according to tags and lines")
    preroll: int = Field(description="exposed before the run's start")
    stored: int = Field(description="in recordings; a line in several counts once")
    discarded: int = Field(description="in no recording: none was requested, or it had ended before")
    lost: dict[str, int] = Field(description="cause → lines")
    waiting: int = Field(description="in the ring")
    pending: int = Field(
        description="in the camera or driver; once idle: left there when the trigger stopped, in no recording"
    )
    balanced: bool


class CheckStatus(Message):
    """Result of checking the lines against the light's code."""

    verdict: Text = Field(description="verified, shifted, inverted, wrong_code, dark or unknown")
    shift: int = Field(description="sub-steps by which the lines are late")
    checked_line: int = Field(description="the line after the last one checked")
    lapped: int = Field(description="ring slots that were overwritten before the check read them")


class ArmStatus(Message):
    """One arm since it was armed: the lines that its camera delivered, and what became of them."""

    delivered: int = Field(description="by the camera, the preroll included")
    preroll: int = Field(description="exposed before the run's start, discarded")
    discarded: int = Field(
        default=0,
        description="in no recording; once idle, delivered = preroll + discarded + lost.ring_full + "
        "ledger.stored",
    )
    lost: dict[str, int] = Field(description="cause → lines")
    recorded: int = Field(description="rows of the latest recording")
    missing: int = Field(description="rows of it without a line")
    rate_hz: float = Field(description="lines per second over the last five seconds")
    saturated: int = Field(default=0, description="lines with a saturated pixel, of those delivered")
    saturated_part: float = Field(default=0.0, description="of the lines of the last five seconds, 0 to 1")
    drift_ppb: int = Field(
        default=0, description="by which the camera's clock is faster than the trigger's; 0 without stamps"
    )
    ring: RingStatus
    ledger: LedgerStatus | None = None
    check: CheckStatus | None = Field(default=None, description="null: the rig has no check")


class RecordingStatus(Message):
    """The recording being written."""

    path: Place
    first_line: int | None = Field(description="the trigger's number of row 0")
    budget_lines: int | None
    recorded_lines: int = Field(description="rows that both arms have")
    committed_lines: int = Field(description="rows that a reader can see, in both arms")
    beyond_bytes: int = Field(
        default=0, description="bytes above recording.retention.max_gb, which are kept because lines are held"
    )
    commit_age_s: float | None = Field(
        default=None,
        description="seconds since lines last became readable, looked at five times a second; null: none yet",
    )


class LastRecording(Message):
    """The recording that was closed last."""

    path: Place
    lines: int
    condition: Text | None = Field(description="condition of the lines; null: it could not be sealed")
    end_reason: Text | None


class RecoveryStatus(Message):
    """A recording that its recorder did not seal, and the state of its recovery."""

    path: Place
    state: Literal["waiting", "recovered", "left", "failed", "gone"] = Field(
        description="waiting: for its turn or a lock; recovered: it is sealed; left: not to be changed by "
        "this daemon, or not a recording; failed: it could not be recovered; gone: it is not there, or "
        "nothing was ever recorded to it"
    )
    lines: int | None = Field(default=None, description="lines of each arm that a reader finds")
    condition: Text | None = Field(default=None, description="condition of the lines, once it is recovered")
    text: Text = Field(default="", description="reason for the state; once it is recovered, its end reason")


class UploadStatus(Message):
    """A recording to be copied to `recording.upload_to`."""

    path: Place
    url: Text
    state: Literal["waiting", "copying", "copied", "refused", "gone"] = Field(
        description="waiting: for its turn, its end or the store; copying: under way, while it grows or "
        "after; copied: complete there; refused: something else is there; gone: deleted here before it was "
        "copied"
    )
    lines: int = Field(default=0, description="lines of each arm at the store")
    waiting_lines: int | None = Field(default=None, description="lines that a reader finds only here")
    bytes: int = Field(default=0, description="bytes sent since the copy was begun or continued")
    error: Text = Field(default="", description="why the last try failed; it is retried while waiting")
    hint: Text = ""


class CapacityStatus(Message):
    """The rate that this host sustains, measured before the run was armed; line rates of both arms."""

    line_rate_hz: float = Field(description="configured rate")
    sustained_hz: float | None = Field(default=None, description="null: could not be measured")
    codec: Text | None = Field(default=None, description="measured codec; chosen if the rig has auto")
    limit: Text | None = Field(default=None, description="the lowest of the limits")
    limits_hz: dict[str, float] = Field(default={}, description="ring, codec, recorder, processors")
    measured: datetime | None = Field(default=None, description="when")
    warning: Text | None = None


class TriggerStatus(Message):
    """The instrument's clock, since it was armed."""

    clock_hz: int
    uncertainty_ns: int = Field(description="uncertainty of its relation to UTC")
    pulses: int = Field(description="number of lines that it has begun")
    silent_s: float = Field(description="seconds since its last tag or answer")
    answers: bool = Field(description="it has not been silent for too long")


class DiskStatus(Message):
    """Room for recordings in the configured directory."""

    directory: Place
    free_bytes: int
    reserve_bytes: int = Field(description="bytes of it that no recording takes")
    bytes_per_s: float = Field(
        description="rate at which it fills, over the last minute of a recording; otherwise the cameras' "
        "uncompressed rate"
    )
    seconds_to_full: float = Field(description="time to the reserve at that rate")


class TroubleStatus(Message):
    """An unforeseen failure outside any command; the service continues."""

    text: Text = Field(description="place and error")
    times: int
    last: datetime


class CalibrationStatus(Message):
    """The calibration in the recordings of this run."""

    path: Place | None = Field(description="path of the rig's calibration")
    carried: bool = Field(description="recordings get a copy")
    text: Text


class Status(Message):
    """What the daemon is doing, and how well."""

    state: State
    since: datetime
    state_s: float = Field(
        default=0.0, description="time in this state, whatever has happened to the host's clock"
    )
    possible: list[Text] = Field(description="commands that the state allows")
    busy: Text | None = Field(
        description="the command being carried out, and after a colon what it is waiting for"
    )
    name: Text = Field(description="name of the rig")
    version: Text
    pid: int
    uptime_s: float
    run_id: Text | None
    recording: RecordingStatus | None
    arms: dict[str, ArmStatus]
    last: LastRecording | None
    waiting: Text | None = Field(
        default=None,
        description="what takes longer than it should, and how long the rings can make up for it, in words",
    )
    fault: Text | None
    trigger: TriggerStatus | None = Field(default=None, description="null: not armed")
    disk: DiskStatus | None = Field(
        default=None, description="null: it has not answered yet, or see `disk_trouble`"
    )
    disk_trouble: Text | None = Field(
        default=None,
        description="why no recording can begin in the configured directory, and what to do: it is not "
        "there, its disk is not mounted, it may not be written, or the disk does not answer",
    )
    capacity: CapacityStatus | None = None
    calibration: CalibrationStatus | None = Field(
        default=None, description="null: not armed, or the rig names none"
    )
    light: LightCode | None = Field(
        default=None,
        description="what the light follows in this run, see `ArmRequest.code`; null: not armed",
    )
    processes: dict[str, int] = Field(default={}, description="processes of the run: name → process number")
    recoveries: list[RecoveryStatus] = Field(
        default=[], description="the latest recordings that were not sealed"
    )
    uploads: list[UploadStatus] = Field(
        default=[],
        description="recordings that are not copied to the store yet, and the latest that are",
    )
    uploads_left: int = Field(default=0, description="number of recordings not copied, listed or not")
    upload_warning: Text | None = Field(default=None, description="why copies may have to wait")
    troubles: list[TroubleStatus] = Field(default=[], description="unforeseen failures, the latest last")


class ErrorMessage(Message):
    """An AcquireError as JSON."""

    error: Text = Field(description="name of the class in acquire.errors")
    message: Text
    possible: Text = ""
    hint: Text = ""
    exit_code: int

    @classmethod
    def of(cls, error: AcquireError) -> ErrorMessage:
        return cls(**error.to_dict())

    def rebuild(self) -> AcquireError:
        """Return the error, of its original class if this version knows it."""
        # The name comes from the other side of the socket: anything but an error of ours is not used.
        known = getattr(errors, self.error, None)
        if not (isinstance(known, type) and issubclass(known, AcquireError)):
            known = AcquireError
        return known(self.message, possible=self.possible, hint=self.hint)


HTTP_STATUS: tuple[tuple[type[AcquireError], int], ...] = (
    (UsageError, 422),
    (BusyError, 503),
    (StateError, 409),
    (NoDaemonError, 503),
    (DeviceError, 503),
    (DataError, 424),
    (AcquireError, 500),
)
"""The first class that matches decides. A recording that is damaged is no defect of the server's (500)."""


RETRY = {"Retry-After": "1"}
"""Header of an answer that is another one a second later."""


def http_status(error: AcquireError) -> int:
    """Return the status code of an answer that reports this error."""
    return next(status for kind, status in HTTP_STATUS if isinstance(error, kind))


def fault_error(fault: str | None) -> DeviceError:
    """Return the error of a command that ends in a fault."""
    return DeviceError(f"fault: {fault}", hint="acquire disarm, then check the device")


def error_body(error: AcquireError) -> dict[str, Any]:
    """Return the JSON body of an answer that reports this error."""
    return ErrorMessage.of(error).model_dump(mode="json")


def release_error(error: OSError) -> DeviceError:
    """Return the error of a run whose devices were not closed in order."""
    what = "; ".join(
        [f"the devices could not be released in order: {error}", *getattr(error, "__notes__", ())]
    )
    return DeviceError(what, hint="acquire devices shows whether each can be opened again")
