"""The messages between the capture's owner and its processes. They are rare: counts go by shared memory.

::

    owner ──▶ recorder      RunStarted, Begin, Cancel, Note, Extend, End, Interrupt, Quit
    recorder ──▶ owner      Ready, Began | Refused, Sealed
    owner ──▶ grabber       Quit
    grabber ──▶ owner       Ready
    watcher ──▶ owner       Ready, Checked, Note
    any process ──▶ owner   Failed, then it ends
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from acquire.stream.losses import Cause
from acquire.stream.window import NOW, Window

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.clock import ClockFit
    from acquire.errors import AcquireError
    from acquire.store import RecordingSpec, RunCondition


@dataclass(frozen=True, slots=True)
class RunStarted:
    """The trigger has started; from now on its tags arrive.

    ``kept``, for a recorder's successor: arm → ranges (first, end) of lines that recordings hold already.
    """

    clock: ClockFit
    kept: dict[str, list[tuple[int, int]]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Begin:
    """A request for a recording, passed from the caller down to the recorder.

    Attributes
    ----------
    path, spec : where to record, and the recording's description without the first line
    lines : the recording's budget; None: until it is ended by `End`
    window : lines around an event; by default from the next line that both arms can give
    end_line : the recording does not go past this line, wherever it begins
    mount : for a further segment, where the disk of the one before is mounted
    """

    path: Path
    spec: RecordingSpec
    lines: int | None = None
    window: Window = NOW
    end_line: int | None = None
    mount: Path | None = None

    @property
    def budget_lines(self) -> int | None:
        """Total number of lines, including those before the window's event; None: until `End`."""
        after = self.window.post_lines
        return self.lines if after is None else self.window.pre_lines + after


@dataclass(frozen=True, slots=True)
class Cancel:
    """Do not begin the recording requested last, because the disk took too long; one that has begun ends."""


@dataclass(frozen=True, slots=True)
class Note:
    """An event at ``line``, to be listed in every recording that holds the line."""

    line: int
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Checked:
    """The verdict on the light's code changes from ``first_line`` on; ``text`` states it in words."""

    first_line: int
    doubtful: bool
    text: str


@dataclass(frozen=True, slots=True)
class Extend:
    """Do not end before ``line``."""

    line: int


@dataclass(frozen=True, slots=True)
class Began:
    """The recording exists, on the disk that is mounted on ``mount``.

    ``end_line``: where it ends without being stopped, if it does.
    """

    first_line: int
    end_line: int | None = None
    mount: Path | None = None


@dataclass(frozen=True, slots=True)
class Refused:
    """The recording cannot be created; nothing has changed."""

    error: AcquireError


@dataclass(frozen=True, slots=True)
class End:
    """End the recording for ``reason``, at ``line`` or at the newest line."""

    reason: str
    line: int | None = None


@dataclass(frozen=True, slots=True)
class Interrupt:
    """End the recording early, for ``reason``; arms in ``lost`` deliver no more, for ``cause``."""

    reason: str
    lost: tuple[str, ...] = ()
    cause: Cause = Cause.ARM_LOST


@dataclass(frozen=True, slots=True)
class Sealed:
    """The recording is closed. If sealing failed, ``on_disk`` is false and it must be recovered.

    ``end_line`` is the line after its last one if the disk was too slow for more: it may continue from there.
    """

    condition: RunCondition
    end_reason: str
    ledger: dict[str, Any]
    on_disk: bool = True
    end_line: int | None = None
