"""The recording that the daemon is making: what was asked for, how far it is, and what became of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.daemon.messages import LastRecording, RecordingStatus

if TYPE_CHECKING:
    from acquire.stream import CaptureStatus
    from acquire.stream.messages import Note


@dataclass(slots=True)
class Take:
    """One recording, from its start until it is sealed.

    Attributes
    ----------
    path : where it begins; a recorder that is killed and replaced goes on beside it
    lines : its budget; None: until it is stopped
    by_event : an event started it, and later events prolong it
    late : the first event that came when it could not be prolonged any more
    """

    path: Path
    lines: int | None
    by_event: bool = False
    late: Note | None = None
    _progress: tuple[int, int] = (-1, -1)
    _moved_s: float = field(default_factory=time.monotonic)

    def idle_s(self, seen: CaptureStatus) -> float:
        """Seconds since more of it was last seen to reach the recorder or the disk."""
        # Either: what is recorded may wait for its commit, and what is committed was recorded long before.
        progress = seen.recorded_lines, seen.committed_lines
        if progress != self._progress:
            self._progress, self._moved_s = progress, time.monotonic()
        return time.monotonic() - self._moved_s

    def status(self, seen: CaptureStatus) -> RecordingStatus:
        """For the daemon's status, while it is being made."""
        return RecordingStatus(
            path=Path(seen.path or self.path),
            first_line=seen.first_line,
            budget_lines=self.lines,
            recorded_lines=seen.recorded_lines,
            committed_lines=seen.committed_lines,
        )

    def result(self, seen: CaptureStatus) -> LastRecording:
        """For the daemon's status, once it has ended."""
        return LastRecording(
            path=Path(seen.path or self.path),
            lines=seen.committed_lines,
            condition=None if seen.condition is None else str(seen.condition),
            end_reason=seen.end_reason,
        )
