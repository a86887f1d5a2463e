"""The daemon's current recording: the request, its progress, and its result."""

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
    path : path at its start; the successor of a killed recorder continues next to it
    lines : its budget; None: until it is stopped
    by_event : an event started it, and later events prolong it
    late : the first event that came too late to prolong it
    """

    path: Path
    lines: int | None
    by_event: bool = False
    late: Note | None = None
    _progress: tuple[int, int] = (-1, -1)
    _moved_s: float = field(default_factory=time.monotonic)

    def idle_s(self, seen: CaptureStatus) -> float:
        """Return the seconds since it last made progress in the recorder or on disk."""
        # Either one: recorded lines may wait for their commit, and committed ones were recorded before.
        progress = seen.recorded_lines, seen.committed_lines
        if progress != self._progress:
            self._progress, self._moved_s = progress, time.monotonic()
        return time.monotonic() - self._moved_s

    def status(self, seen: CaptureStatus) -> RecordingStatus:
        """Return the status of the recording while it is being written."""
        return RecordingStatus(
            path=Path(seen.path or self.path),
            first_line=seen.first_line,
            budget_lines=self.lines,
            recorded_lines=seen.recorded_lines,
            committed_lines=seen.committed_lines,
            beyond_bytes=seen.beyond_bytes,
        )

    def result(self, seen: CaptureStatus) -> LastRecording:
        """Return the result for the daemon's status, once the recording has ended."""
        return LastRecording(
            path=Path(seen.path or self.path),
            lines=seen.committed_lines,
            condition=None if seen.condition is None else str(seen.condition),
            end_reason=seen.end_reason,
        )
