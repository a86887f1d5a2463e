"""What the capture's owner and its processes say to each other. Few and rare: counts go by shared memory.

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
    """The trigger started; from now on its tags arrive. ``kept``: arm → ranges of lines, first and end, that
    are in recordings already, for the successor of a recorder.
    """

    clock: ClockFit
    kept: dict[str, list[tuple[int, int]]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Begin:
    """A recording that is asked for, by whoever asks, down to the recorder.

    Attributes
    ----------
    path, spec : where, and all that it says of itself but the first line, which the recorder sets
    lines : its budget; None: until it is told to end
    window : from the next line that both arms can give, unless it begins earlier
    end_line : it does not go past this, wherever it begins
    """

    path: Path
    spec: RecordingSpec
    lines: int | None = None
    window: Window = NOW
    end_line: int | None = None

    @property
    def budget_lines(self) -> int | None:
        """Lines in all, those before the window's event counted; None: until it is told to end."""
        after = self.window.post_lines
        return self.lines if after is None else self.window.pre_lines + after


@dataclass(frozen=True, slots=True)
class Cancel:
    """Do not begin what was asked for last: the disk took too long; one that has begun ends."""


@dataclass(frozen=True, slots=True)
class Note:
    """Something happened at ``line``: for the events of every recording that holds it."""

    line: int
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Checked:
    """From ``first_line`` on the lines say something else of the light's code than before, in words."""

    first_line: int
    doubtful: bool
    text: str


@dataclass(frozen=True, slots=True)
class Extend:
    """Do not end before ``line``."""

    line: int


@dataclass(frozen=True, slots=True)
class Began:
    """The recording exists; ``end_line``: where it ends by itself, if it does."""

    first_line: int
    end_line: int | None = None


@dataclass(frozen=True, slots=True)
class Refused:
    """The recording cannot be made; nothing changed."""

    error: AcquireError


@dataclass(frozen=True, slots=True)
class End:
    """End the recording at ``line``, or at the newest one, for ``reason``."""

    reason: str
    line: int | None = None


@dataclass(frozen=True, slots=True)
class Interrupt:
    """End the recording early, for ``reason``; what the arms in ``lost`` owe is missing by ``cause``."""

    reason: str
    lost: tuple[str, ...] = ()
    cause: Cause = Cause.ARM_LOST


@dataclass(frozen=True, slots=True)
class Sealed:
    """The recording is over and closed; not ``on_disk``, where that failed: somebody must recover it.

    ``end_line`` is the line after its last one where the disk was too slow for more: it may go on.
    """

    condition: RunCondition
    end_reason: str
    ledger: dict[str, Any]
    on_disk: bool = True
    end_line: int | None = None
