"""Successors of killed processes: who takes over, how often, and how the recording continues.

::

    grabber killed   ─▶ another opens the camera; its first line's number follows from the time stamps, and
                        the lines in between are a gap, `Cause.GRABBER_LOST`
    recorder killed  ─▶ another begins a new segment next to the recording that was cut off, from the first
                        line that the last commit does not cover; lines that the ring no longer holds are
                        a gap, `Cause.RECORDER_LOST`; the recording that was cut off is an `Orphan`
    disk too slow    ─▶ the recording ends, sealed, and the same recorder begins another segment as soon as
                        the disk allows; the lines in between are an outage, and part of neither

A process that reported an error before it ended (of its camera, or a full disk) has no successor: it would
meet the same error.
"""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from acquire.store import Continuation
from acquire.store.spec import readout_ns
from acquire.stream.messages import Note
from acquire.stream.window import Window

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from acquire.processes.worker import Worker
    from acquire.stream.messages import Began, Begin

MOST = 5
"""Number of successors of one process in a run: one that dies more often has a permanent problem."""
_SHORT_S = 60.0
"""A segment that lasts for less shows that the disk is still in trouble."""
_LONGEST_WAIT_S = 60.0
"""Upper limit on the wait before an attempt, which doubles as long as attempts fail."""
_THEN = "; and then "
READY_S = 120.0
"""How long a successor may take to become ready."""


@dataclass(frozen=True, slots=True)
class Orphan:
    """A recording that its recorder did not live to seal, and why.

    ``committed_lines`` of it were acknowledged. ``notes`` were sent to its recorder, which may not have
    written them; some concern lines of other recordings.
    """

    path: Path
    why: str
    committed_lines: int = 0
    notes: tuple[Note, ...] = ()


class Resumption:
    """When a recording that the disk has ended continues in a further segment.

    At first at once, then later and later while segments stay short: a permanently slow disk must not be
    filled with short segments.
    """

    def __init__(self) -> None:
        self._failures = 0
        self._began_s = -math.inf
        self._due_s: float | None = None
        self.why = ""
        """Why the recording has not continued yet; "" if it has."""

    def began(self, now_s: float) -> None:
        """Note that a segment began."""
        self._began_s = now_s
        self._due_s, self.why = None, ""

    def ended(self, now_s: float, why: str) -> None:
        """Note that a segment ended, or could not begin."""
        self.why = why
        # Resume at once the first time, then after 1 s, 2 s, 4 s … as long as segments stay short.
        self._failures = 0 if now_s - self._began_s > _SHORT_S else self._failures + 1
        self._began_s = now_s
        wait_s = 2.0 ** (self._failures - 2) if self._failures > 1 else 0.0
        self._due_s = now_s + min(wait_s, _LONGEST_WAIT_S)

    @property
    def is_waiting(self) -> bool:
        """Whether the next attempt has its time, and none is under way."""
        return self._due_s is not None

    def is_due(self, now_s: float) -> bool:
        """Return whether the next segment is to be tried now; True once per attempt."""
        if self._due_s is None or now_s < self._due_s:
            return False
        self._due_s = None
        return True


@dataclass(slots=True)
class WorkerSlot:
    """One role of the run, and the processes that filled it one after the other."""

    spawn: Callable[[], Worker | None]
    successors: int = 0
    ready_by_s: float | None = None


class Succession:
    """The successors of a run's processes.

    Parameters
    ----------
    spawn : name → starts a successor, or returns None if none can continue
    """

    def __init__(self, spawn: Mapping[str, Callable[[], Worker | None]]) -> None:
        self._slots = {name: WorkerSlot(start) for name, start in spawn.items()}

    def successor(self, name: str) -> Worker | None:
        """Start a process in the place of one that was killed; None if that is not possible."""
        slot = self._slots.get(name)
        if slot is None or slot.successors >= MOST:
            return None
        worker = slot.spawn()
        if worker is not None:
            slot.successors += 1
            slot.ready_by_s = time.monotonic() + READY_S
        return worker

    def is_starting(self, name: str) -> bool:
        """Return whether a successor is not ready yet, so that its silence means nothing."""
        return self._slots[name].ready_by_s is not None if name in self._slots else False

    def is_late(self, name: str) -> bool:
        """Return whether a successor has not become ready in time."""
        ready_by_s = self._slots[name].ready_by_s if name in self._slots else None
        return ready_by_s is not None and time.monotonic() > ready_by_s

    def ready(self, name: str) -> None:
        """Note that the process has reported that it is ready."""
        if name in self._slots:
            self._slots[name].ready_by_s = None


def continuation(begin: Begin, began: Began, committed_lines: int, why: str) -> Begin:
    """Return the request for the segment after a recording that was cut off after ``committed_lines``."""
    at = began.first_line + committed_lines
    # At least one, as a window requires: all lines of a recording that was not sealed may be committed.
    left = None if began.end_line is None else max(1, began.end_line - at)
    cause = f"its recorder was {why}"
    text = f"continues from {begin.path.name}: {cause}"
    window = Window(at, post_lines=left, exact=False, padded=True, kind="resumed", text=text)
    spec, before = begin.spec, begin.spec.continues
    first, number = (begin.path.name, 2) if before is None else (before.first, before.number + 1)
    # Writing the list of segments into the first recording would delay this one: recovery does it later.
    follows = Continuation(first, number, at, readout_ns(spec, at), cause, listed=False)
    path = free_name(begin.path.with_name(first))
    spec = replace(spec, continues=follows)
    return replace(begin, path=path, spec=spec, lines=None, window=window, mount=began.mount)


def resumed(begin: Begin, began: Began, end_line: int, why: str) -> Begin | None:
    """Return the request for the segment after a recording that was sealed at ``end_line``.

    It begins with the next line and has the same end; None if that end is reached.
    """
    if began.end_line is not None and began.end_line <= end_line:
        return None
    spec, before = begin.spec, begin.spec.continues
    first, number = (begin.path.name, 2) if before is None else (before.first, before.number + 1)
    follows = Continuation(first, number, end_line, readout_ns(spec, end_line), why)
    window = Window(kind="resumed", text=f"continues from {begin.path.name}: {why}")
    path = free_name(begin.path.with_name(first))
    following = replace(begin, path=path, spec=replace(spec, continues=follows), lines=None, window=window)
    return replace(following, end_line=began.end_line, mount=began.mount)


def once_more(following: Begin, why: str = "") -> Begin:
    """Return the continuation with a free name, to be tried again; ``why`` it could not begin before."""
    follows, window = following.spec.continues, following.window
    assert follows is not None
    if why not in ("", follows.cause):
        window = replace(window, text=f"{window.text.partition(_THEN)[0]}{_THEN}{why}")
    return replace(following, path=free_name(following.path.with_name(follows.first)), window=window)


def free_name(path: Path) -> Path:
    """Return the first of NAME-2, NAME-3 … next to ``path`` that does not exist."""
    number = 2
    # lexists: a dangling link takes the name as well.
    while os.path.lexists(found := path.with_name(f"{path.stem}-{number}{path.suffix}")):
        number += 1
    return found


def replacement_note(worker: str, why: str, line: int) -> Note:
    """Return the note that ``worker`` was replaced."""
    return Note(line, "fault", f"{worker}: {why}; another took its place")
