"""A recording that is being created: its lines, and the earlier events that belong to it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from acquire.errors import StoreError
from acquire.store import RecordingWriter
from acquire.store.mount import refuse_unmounted
from acquire.store.suspect import CODE_EVENTS, DOUBTFUL
from acquire.stream.messages import Note

if TYPE_CHECKING:
    from concurrent.futures import Future

    from acquire.store.files import Disk
    from acquire.stream.messages import Begin
    from acquire.stream.window import Span

_MOST_NOTES = 1024
"""Number of events remembered for recordings that begin later and hold their lines."""


@dataclass(frozen=True, slots=True)
class Opening:
    """A recording that is being created, for the lines in ``span``; None: for those after its creation."""

    begin: Begin
    span: Span | None
    writer: Future[RecordingWriter]

    def is_over(self, first_line: int) -> bool:
        """Return whether a recording from ``first_line`` on would begin at or after its end."""
        return self.begin.end_line is not None and first_line >= self.begin.end_line

    def lines_from(self, first_line: int) -> int | None:
        """Return the number of lines it takes from ``first_line`` on; None: until `End`."""
        if self.span is not None:
            return None if self.span.end_line is None else self.span.end_line - first_line
        return self.begin.lines if self.begin.end_line is None else self.begin.end_line - first_line


def prepare(begin: Begin, disk: Disk) -> RecordingWriter:
    """Do everything that takes time; a further segment needs the disk on which the one before was begun."""
    refuse_unmounted(begin.path, begin.mount)
    return RecordingWriter.prepare(begin.path, begin.spec, disk)


class Notes:
    """Recent events and their lines."""

    def __init__(self) -> None:
        self._notes: deque[Note] = deque(maxlen=_MOST_NOTES)

    def add(self, note: Note) -> None:
        self._notes.append(note)

    def before_and_since(self, first_line: int) -> list[Note]:
        """Return all events for a recording that begins at ``first_line``.

        They are preceded by the doubts about an arm's code that arose earlier and still hold at that line.
        """
        # By arm, in whose name these kinds end; a later verdict takes the place of an earlier one.
        latest = {note.kind[-1]: note for note in self._notes if is_verdict(note, before=first_line)}
        doubts = [note for note in latest.values() if note.kind in DOUBTFUL.values()]
        return [*(replace(note, line=first_line) for note in doubts), *self._notes]


def is_verdict(note: Note, *, before: int) -> bool:
    """Return whether the note is a verdict on the code that began before the line ``before``."""
    return note.kind in CODE_EVENTS and note.line < before


def not_created(error: Exception) -> StoreError:
    """Return the error of a recording whose files could not be created."""
    what = f"the recording cannot be created: {error!r}"
    return StoreError(what, hint="free space and memory on this host, or another directory")
