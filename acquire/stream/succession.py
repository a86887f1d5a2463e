"""Who takes the place of a process that was killed, how often, and how the recording goes on.

::

    grabber killed   ─▶ another opens the camera; the line it goes on with follows from the time stamps,
                        and what came between is a gap, `Cause.GRABBER_LOST`
    recorder killed  ─▶ another begins a recording beside the one that was cut off, from the first line on
                        that this one's last commit does not cover; what the ring does not hold any more
                        is a gap, `Cause.RECORDER_LOST`; the one that was cut off is an `Orphan`
    disk too slow    ─▶ the recording ends, sealed, and the same recorder begins another beside it as soon as
                        the disk lets it; what came between is an outage, and part of neither

A process that ended with a word of its own (an error of its camera, a full disk) has said why it cannot go
on; nobody takes its place.
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
"""Successors of one process in a run: what dies more often has a reason."""
_SHORT_S = 60.0
"""A segment that lasts for less says that the disk still has trouble."""
_LONGEST_WAIT_S = 60.0
READY_S = 120.0
"""How long a successor may take until it is ready."""


@dataclass(frozen=True, slots=True)
class Orphan:
    """A recording whose recorder did not live to seal it, and why; lines of it were acknowledged.

    ``told``: what its recorder was told of, which it may not have written; lines of other recordings, too.
    """

    path: Path
    why: str
    committed_lines: int = 0
    told: tuple[Note, ...] = ()


class Resumption:
    """When a recording that the disk has ended goes on in a further segment.

    At once, and ever later where the disk takes no segment for long: a disk that is too slow for good must
    not be filled with short ones.
    """

    def __init__(self) -> None:
        self._failures = 0
        self._began_s = -math.inf
        self._due_s: float | None = None
        self.why = ""
        """Why the recording has not gone on yet; "" where it has."""

    def began(self, now_s: float) -> None:
        """The recording goes on."""
        self._began_s = now_s
        self._due_s, self.why = None, ""

    def ended(self, now_s: float, why: str) -> None:
        """A segment ended, or could not begin."""
        self.why = why
        # The first goes on at once, the next after 1 s, 2 s, 4 s … for as long as segments stay short.
        self._failures = 0 if now_s - self._began_s > _SHORT_S else self._failures + 1
        self._began_s = now_s
        wait_s = 2.0 ** (self._failures - 2) if self._failures > 1 else 0.0
        self._due_s = now_s + min(wait_s, _LONGEST_WAIT_S)

    def is_due(self, now_s: float) -> bool:
        """It is to be tried now; said once."""
        if self._due_s is None or now_s < self._due_s:
            return False
        self._due_s = None
        return True


@dataclass(slots=True)
class WorkerSlot:
    """The processes that had one place, one after the other."""

    spawn: Callable[[], Worker | None]
    successors: int = 0
    ready_by_s: float | None = None


class Succession:
    """The successors of a run's processes.

    Parameters
    ----------
    spawn : name → starts a successor; gives None where nobody can go on
    """

    def __init__(self, spawn: Mapping[str, Callable[[], Worker | None]]) -> None:
        self._slots = {name: WorkerSlot(start) for name, start in spawn.items()}

    def successor(self, name: str) -> Worker | None:
        """A new process in the place of one that was killed, or None."""
        slot = self._slots.get(name)
        if slot is None or slot.successors >= MOST:
            return None
        worker = slot.spawn()
        if worker is not None:
            slot.successors += 1
            slot.ready_by_s = time.monotonic() + READY_S
        return worker

    def is_starting(self, name: str) -> bool:
        """A successor is not ready yet: its silence means nothing."""
        return self._slots[name].ready_by_s is not None if name in self._slots else False

    def is_late(self, name: str) -> bool:
        """A successor has not become ready in time."""
        ready_by_s = self._slots[name].ready_by_s if name in self._slots else None
        return ready_by_s is not None and time.monotonic() > ready_by_s

    def ready(self, name: str) -> None:
        """The process has said that it is ready."""
        if name in self._slots:
            self._slots[name].ready_by_s = None


def continuation(begin: Begin, began: Began, committed_lines: int, why: str) -> Begin:
    """What has a recorder go on with a recording that was cut off after ``committed_lines`` lines."""
    at = began.first_line + committed_lines
    # One at least, as a window must have: all lines may be committed of a recording that was not sealed.
    left = None if began.end_line is None else max(1, began.end_line - at)
    cause = f"its recorder was {why}"
    text = f"goes on from {begin.path.name}: {cause}"
    window = Window(at, post_lines=left, exact=False, padded=True, kind="resumed", text=text)
    spec, before = begin.spec, begin.spec.continues
    first, number = (begin.path.name, 2) if before is None else (before.first, before.number + 1)
    # Nobody may be kept waiting for the first recording: whoever recovers it lists its segments.
    follows = Continuation(first, number, at, readout_ns(spec, at), cause, listed=False)
    path = free_name(begin.path.with_name(first))
    return replace(begin, path=path, spec=replace(spec, continues=follows), lines=None, window=window)


def resumed(begin: Begin, began: Began, end_line: int, why: str) -> Begin | None:
    """What has a recorder go on with a recording that it sealed after ``end_line`` lines, if that has an end
    to come: from the next line on, up to the same end.
    """
    if began.end_line is not None and began.end_line <= end_line:
        return None
    spec, before = begin.spec, begin.spec.continues
    first, number = (begin.path.name, 2) if before is None else (before.first, before.number + 1)
    follows = Continuation(first, number, end_line, readout_ns(spec, end_line), why)
    window = Window(kind="resumed", text=f"goes on from {begin.path.name}: {why}")
    path = free_name(begin.path.with_name(first))
    spec = replace(spec, continues=follows)
    return replace(begin, path=path, spec=spec, lines=None, window=window, end_line=began.end_line)


def once_more(following: Begin) -> Begin:
    """A continuation that is tried again, since it could not begin."""
    assert following.spec.continues is not None
    return replace(following, path=free_name(following.path.with_name(following.spec.continues.first)))


def free_name(path: Path) -> Path:
    """The first of NAME-2, NAME-3 … beside ``path`` that does not exist."""
    number = 2
    while os.path.lexists(found := path.with_name(f"{path.stem}-{number}{path.suffix}")):
        number += 1  # a link that leads nowhere has the name as well
    return found


def replacement_note(worker: str, why: str, line: int) -> Note:
    """The event of a succession."""
    return Note(line, "fault", f"{worker}: {why}; another took its place")
