"""Recordings that nobody sealed: the daemon recovers them automatically, in a process of low priority.

::

    a recorder was killed (`CaptureStatus.orphans`) ─┐
    found open when the daemon started ──────────────┼▶ Salvage ─▶ process: recover, one by one ─▶ status
    an earlier daemon recorded it (`Journal`) ───────┘

What another process still writes is left to it: the lock of its directory tells. So is what another machine
wrote, what lies where there are no locks, what holds links, and what is no recording: it is named in the
status and in the log, once, and not touched. The process ends at once when a run is armed, unless it is
after what that run itself has left; a recovery that was cut off begins anew afterwards.
"""

from __future__ import annotations

import contextlib
import logging
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

from acquire.daemon.journal import Journal
from acquire.daemon.messages import RecoveryStatus
from acquire.daemon.recoverer import RECOVERED, Found, Task, hindrance, salvage, search
from acquire.errors import DeviceError
from acquire.processes.messages import Failed
from acquire.processes.worker import Worker

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from acquire.stream import Orphan

AGAIN_S = 5.0
"""Between two looks at a recording that another process holds."""
MOST_TRIES = 6
MOST_LISTED = 32
"""Recordings of which the status tells, the latest: more than one run can leave."""
MOST_ODD = 8
"""Entries of the directory that are no recordings, of which the status tells."""
_END_S = 5.0
_POLL_S = 0.02

log = logging.getLogger("acquire.daemon")


class Salvage:
    """What is to be recovered, and what became of it. For one thread; only `wait` and `close` wait.

    Parameters
    ----------
    directory : searched for recordings that were left open, once `search` is called
    journal : file that names what is being recorded, wherever that is
    """

    def __init__(self, directory: Path, journal: Path | None = None) -> None:
        self._directory = directory
        self._journal = Journal(journal, "not_sealed", "not sealed")
        self._not_sealed: dict[Path, None] = {}
        self._tasks: dict[Path, Task] = {}
        self._found: dict[Path, RecoveryStatus] = {}
        self._worker: Worker | None = None
        self._under_way: Task | None = None
        self._searching: Future[Found] | None = None

    @property
    def recoveries(self) -> list[RecoveryStatus]:
        """The latest; for the status."""
        return list(self._found.values())

    def search(self) -> None:
        """Look for recordings that a killed daemon has left; `poll` will find them."""
        self._not_sealed = dict.fromkeys(self._journal.read())
        # In a thread: a directory of thousands, or on a slow disk, does not keep the daemon from beginning.
        thread = ThreadPoolExecutor(1, "salvage")
        self._searching = thread.submit(search, self._directory, list(self._not_sealed))
        thread.shutdown(wait=False)

    def began(self, path: Path) -> None:
        """A run records there; the next daemon has to know, should this one be killed."""
        if path not in self._not_sealed:
            self._not_sealed[path] = None
            self._journal.write(self._not_sealed)

    def ended(self, path: Path) -> None:
        """It is sealed; or it is among the orphans, and not forgotten yet."""
        if path not in self._tasks and path in self._not_sealed:
            del self._not_sealed[path]
            self._journal.write(self._not_sealed)

    def add(self, orphans: Iterable[Orphan]) -> None:
        """Recover what a run has left; what is known already is passed over."""
        for orphan in orphans:
            found = self._tasks.get(orphan.path)  # the search may have met it while it was being written
            if orphan.path not in self._found or (found is not None and not found.ours):
                log.warning("%s was not sealed: %s", orphan.path, orphan.why)
                notes = tuple((note.line, note.kind, note.text) for note in orphan.notes)
                self._queue(Task(orphan.path, orphan.why, True, orphan.committed_lines, notes=notes))

    def poll(self, *, capturing: bool = False) -> list[RecoveryStatus]:
        """Hear what is done, begin what is next; what came to an end since the last look.

        While ``capturing``, only what the run itself has left is recovered.
        """
        if self._searching is not None and self._searching.done():
            searching, self._searching = self._searching, None  # taken once, whatever comes of it
            self._take_search(searching)
        ended = self._hear()
        if capturing and self._under_way is not None and not self._under_way.ours:
            self._stand_back()
        if self._worker is None:
            ended += self._begin(capturing=capturing)
        return ended

    def wait(self, timeout_s: float) -> list[RecoveryStatus]:
        """Until what this daemon's runs have left is recovered, or the time is up; what came to an end."""
        deadline = time.monotonic() + timeout_s
        ended: list[RecoveryStatus] = []
        while any(task.ours and not task.tries for task in self._tasks.values()):
            ended += self.poll(capturing=True)
            if time.monotonic() > deadline:
                log.error("not recovered in time: %s", ", ".join(map(str, self._tasks)))
                break
            time.sleep(_POLL_S)
        return ended

    def close(self) -> None:
        """End what is under way; a daemon that comes later finds it. Idempotent."""
        self._stand_back()
        self._tasks.clear()

    def _queue(self, task: Task) -> None:
        self._tasks[task.path] = task
        self._tell(RecoveryStatus(path=task.path, state="waiting", text=task.why))

    def _tell(self, status: RecoveryStatus) -> None:
        self._found.pop(status.path, None)  # the latest come last
        self._found[status.path] = status
        while len(self._found) > MOST_LISTED:
            del self._found[next(iter(self._found))]

    def _take_search(self, searching: Future[Found]) -> None:
        try:
            found = searching.result()
        except OSError as error:
            log.warning("%s cannot be searched for open recordings: %s", self._directory, error.strerror)
            return
        for one in found.odd[:MOST_ODD]:
            log.warning("%s %s: %s", one.path, one.state, one.text)
            if one.path not in self._found:
                self._tell(one)
        if len(found.odd) > MOST_ODD:
            log.warning("%d more like these in %s", len(found.odd) - MOST_ODD, self._directory)
        for path in found.open:
            if path not in self._found:
                self._queue(Task(path))
        met = {*found.open, *(one.path for one in found.odd)}
        for path in [path for path in self._not_sealed if path not in met]:
            self.ended(path)

    def _begin(self, *, capturing: bool) -> list[RecoveryStatus]:
        """The next that nobody holds, our own first; those that are held come later, and end some time."""
        now_s = time.monotonic()
        able = [
            task
            for task in self._tasks.values()
            if task.not_before_s <= now_s and (task.ours or not capturing)
        ]
        ended: list[RecoveryStatus] = []
        for task in sorted(able, key=lambda task: not task.ours):
            hindered = hindrance(task) or self._spawn(task)
            if hindered is None:
                break
            ended += self._heed(task, hindered)
        return ended

    def _spawn(self, task: Task) -> RecoveryStatus | None:
        try:
            self._worker = Worker("salvage", salvage, task)
        except DeviceError as error:
            return RecoveryStatus(path=task.path, state="failed", text=str(error))
        self._under_way = task
        return None

    def _hear(self) -> list[RecoveryStatus]:
        worker, task = self._worker, self._under_way
        if worker is None or task is None:
            return []
        death = worker.death  # asked first: what a process said last is still in its pipe then
        said = worker.message()
        if said is None and death is None:
            return []
        self._worker = self._under_way = None
        _end(worker, _END_S)
        if not isinstance(said, RecoveryStatus):
            why = said.error if isinstance(said, Failed) else death
            said = RecoveryStatus(path=task.path, state="failed", text=f"the recovering process: {why}")
        return self._heed(task, said)

    def _heed(self, task: Task, said: RecoveryStatus) -> list[RecoveryStatus]:
        del self._tasks[task.path]
        self._tell(said)
        if said.state == "waiting" and task.tries + 1 < MOST_TRIES:
            later = time.monotonic() + AGAIN_S
            self._tasks[task.path] = replace(task, tries=task.tries + 1, not_before_s=later)
            return []
        if said.state == "waiting":
            said = said.model_copy(update={"state": "left"})
            self._tell(said)
        if said.state == "recovered" or (said.state == "gone" and not task.committed_lines):
            self.ended(said.path)
        level = logging.INFO if said.state == "recovered" else logging.WARNING
        log.log(level, "%s %s: %s", said.path, said.state, said.text.removeprefix(RECOVERED))
        return [said]

    def _stand_back(self) -> None:
        worker, self._worker, self._under_way = self._worker, None, None
        if worker is not None:
            _end(worker, 0.0)


def _end(worker: Worker, within_s: float) -> None:
    """By force after a while, which costs nothing: what was cut off begins anew."""
    with contextlib.suppress(DeviceError):
        worker.end(time.monotonic() + within_s)
