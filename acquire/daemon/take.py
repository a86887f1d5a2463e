"""The daemon's current recording: the request, its progress, and its result."""

from __future__ import annotations

import logging
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.daemon.messages import LastRecording, RecordingStatus
from acquire.logs import EACH
from acquire.store import RunCondition
from acquire.stream import CaptureStatus
from acquire.text import counted, shortened

if TYPE_CHECKING:
    from acquire.stream.messages import Note


MOST_MARKS = 1000
MOST_NAMED = 5
"""Number of marks that are named in the reason of a fault."""

log = logging.getLogger("acquire.daemon")


def log_event(note: Note, take: Take | None) -> None:
    """Write an event into the log; an operator's mark always, since the recording may end before its line."""
    text = f": {note.text}" if note.text else ""
    if note.kind != "mark":
        log.info("event: %s at line %d%s", note.kind, note.line, text)
        return
    # Another form of entry, whose repetitions are counted on their own.
    log.info("event: mark at line %d%s", note.line, text, extra=EACH)
    if take is not None:
        take.marks.append(note)


def with_cause(trouble: str, seen: CaptureStatus, *, ending: bool) -> str:
    """Return the text of a failure, after its probable cause: the reason why the recording ended."""
    cause = seen.fault
    if cause is None and ending and seen.condition is not RunCondition.GOOD:
        cause = seen.end_reason
    return and_then(cause, trouble) if cause else trouble


def in_words(last: LastRecording) -> str:
    """Return the result of a recording as one line for log and news."""
    return f"{last.path}, {counted(last.lines, 'line')}, {last.condition}, {last.end_reason}"


def and_then(cause: str, trouble: str) -> str:
    """Return the text of a failure with what went wrong after it, unless that is the same."""
    return cause if trouble in cause else f"{cause}; then, while ending: {trouble}"


@dataclass(slots=True)
class Take:
    """One recording, from its start until it is sealed.

    Attributes
    ----------
    path : path at its start; the successor of a killed recorder continues next to it
    lines : its budget; None: until it is stopped
    by_event : an event started it, and later events prolong it
    late : the first event that came too late to prolong it
    before : path of the recording before it, if that is another
    marks : the latest marks since its start
    """

    path: Path
    lines: int | None
    by_event: bool = False
    late: Note | None = None
    before: str | None = None
    marks: deque[Note] = field(default_factory=lambda: deque(maxlen=MOST_MARKS))
    _progress: tuple[int, int] = (-1, -1)
    _moved_s: float = field(default_factory=time.monotonic)
    _commit: tuple[int, float] = (0, 0.0)

    @property
    def in_words(self) -> str:
        """The request, for log and news."""
        return f"{self.path}, {'until stopped' if self.lines is None else counted(self.lines, 'line')}"

    def idle_s(self, seen: CaptureStatus) -> float:
        """Return the seconds since it last made progress in the recorder or on disk."""
        # Either one: recorded lines may wait for their commit, and committed ones were recorded before.
        progress = seen.recorded_lines, seen.committed_lines
        if progress != self._progress:
            self._progress, self._moved_s = progress, time.monotonic()
        return time.monotonic() - self._moved_s

    def path_now(self, seen: CaptureStatus) -> Path:
        """Return its own path, or that of the segment in which it continues."""
        return self.path if seen.path in (None, self.before) else Path(seen.path)

    def status(self, seen: CaptureStatus) -> RecordingStatus:
        """Return the status of the recording while it is being written."""
        if seen.path == self.before:  # of the recording before it, as long as nothing of this one was seen
            seen = CaptureStatus()
        return RecordingStatus(
            path=self.path_now(seen),
            first_line=seen.first_line,
            budget_lines=self.lines,
            recorded_lines=seen.recorded_lines,
            committed_lines=seen.committed_lines,
            beyond_bytes=seen.beyond_bytes,
            commit_age_s=self._commit_age_s(seen.committed_lines),
        )

    def _commit_age_s(self, committed: int) -> float | None:
        """Return the time since the number of committed lines was last seen to rise; None before that."""
        if committed != self._commit[0]:
            self._commit = committed, time.monotonic()
        return round(time.monotonic() - self._commit[1], 3) if committed else None

    def marks_after(self, seen: CaptureStatus) -> str:
        """Return a clause on the marks after the last line of a recording that has ended; "" if none."""
        end = (seen.first_line or 0) + seen.committed_lines
        after = [f"{shortened(note.text, 60)!r}" for note in self.marks if note.line >= end]
        if not after:
            return ""
        more = f" and {len(after) - MOST_NAMED} more" if len(after) > MOST_NAMED else ""
        named = ", ".join(after[:MOST_NAMED]) + more
        return f"; marks of lines after its last one, of which only the log is sure to have all: {named}"

    def result(self, seen: CaptureStatus) -> LastRecording:
        """Return the result for the daemon's status, once the recording has ended, and log what it lacks."""
        path = self.path_now(seen)
        if more := seen.ledger.get("events_not_listed"):
            text = "%s does not list its last %s: their table is full; this log has all marks"
            log.warning(text, path, counted(more, "event"))
        return LastRecording(
            path=path,
            lines=seen.committed_lines,
            condition=None if seen.condition is None else str(seen.condition),
            end_reason=seen.end_reason,
        )
