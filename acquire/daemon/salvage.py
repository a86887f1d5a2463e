"""Automatic recovery of recordings that were not sealed, in a process of low priority.

::

    a recorder was killed (`CaptureStatus.orphans`) ─┐
    found open when the daemon started ──────────────┼▶ Salvage ─▶ process: recover, one by one ─▶ status
    an earlier daemon recorded it (`Journal`) ───────┘

A recording that another process still writes, as the lock of its directory shows, is left to it. Others are
reported once, in the status and in the log, and not touched: those written by another machine, on a file
system without locks, or with links, and anything that is not a recording. The process ends at once when a
run is armed, unless it recovers a recording of that run; an interrupted recovery is repeated afterwards.
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
from acquire.daemon.recoverer import RECOVERED, Found, RecoveryTask, hindrance, salvage, search
from acquire.errors import DeviceError
from acquire.logs import EACH
from acquire.processes.messages import Failed
from acquire.processes.worker import Worker

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from acquire.stream import Orphan

AGAIN_S = 5.0
"""Time between two attempts at a recording that another process holds."""
MOST_TRIES = 6
"""Number of attempts at a recording that another process holds."""
MOST_LISTED = 32
"""Number of latest recordings in the status: more than one run can leave."""
MOST_ODD = 8
"""Number of entries of the directory in the status that are not recordings."""
_MAY_COME_BACK = ("gone", "failed")
"""States of recordings that another search may find whole: their disk was not mounted, or had failed."""
_END_S = 5.0
_POLL_S = 0.02

log = logging.getLogger("acquire.daemon")


class Salvage:
    """Recordings to be recovered, and the results. For one thread; only `wait` and `close` wait.

    Parameters
    ----------
    directory : directory in which `search` looks for recordings that were left open
    journal : file that lists what is being recorded, wherever that is
    """

    def __init__(self, directory: Path, journal: Path | None = None) -> None:
        self._directory = directory
        self._journal = Journal(journal, "not_sealed", "not sealed")
        self._not_sealed: dict[Path, None] = {}
        self._begun: set[Path] = set()
        """Recordings of this daemon's runs that began during the search; their ends are reported."""
        self._tasks: dict[Path, RecoveryTask] = {}
        self._found: dict[Path, RecoveryStatus] = {}
        self._worker: Worker | None = None
        self._under_way: RecoveryTask | None = None
        self._searching: Future[Found] | None = None

    @property
    def recoveries(self) -> list[RecoveryStatus]:
        """The latest recoveries, for the status."""
        return list(self._found.values())

    def search(self) -> None:
        """Start a search for recordings that a killed daemon has left; `poll` takes its result.

        Again once the directory is back, with the journal that it has.
        """
        if self._searching is not None:
            return
        self._not_sealed = dict.fromkeys([*self._journal.read(), *self._not_sealed])
        self._journal.write(self._not_sealed)
        # In a thread: a directory of thousands, or on a slow disk, must not delay the daemon's start.
        thread = ThreadPoolExecutor(1, "salvage")
        self._searching = thread.submit(search, self._directory, list(self._not_sealed))
        thread.shutdown(wait=False)

    def began(self, path: Path) -> None:
        """Note that a run records there, for the next daemon, should this one be killed."""
        if self._searching is not None:
            self._begun.add(path)
        if path not in self._not_sealed:
            self._not_sealed[path] = None
            self._journal.write(self._not_sealed)

    def ended(self, path: Path) -> None:
        """Note that the recording is sealed. If it is an orphan, it stays in the journal."""
        if path not in self._tasks and path in self._not_sealed:
            del self._not_sealed[path]
            self._journal.write(self._not_sealed)

    def add(self, orphans: Iterable[Orphan]) -> None:
        """Recover a run's orphans, except those known already."""
        for orphan in orphans:
            found = self._tasks.get(orphan.path)  # the search may have found it while it was being written
            if orphan.path not in self._found or (found is not None and not found.ours):
                log.warning("%s was not sealed: %s", orphan.path, orphan.why)
                notes = tuple((note.line, note.kind, note.text) for note in orphan.notes)
                self._queue(RecoveryTask(orphan.path, orphan.why, True, orphan.committed_lines, notes=notes))

    def poll(self, *, capturing: bool = False) -> list[RecoveryStatus]:
        """Take results, begin the next recovery, and return those that ended since the last call.

        While ``capturing``, only the run's own recordings are recovered.
        """
        if self._searching is not None and self._searching.done():
            searching, self._searching = self._searching, None  # taken once, even if it failed
            self._take_search(searching)
            self._begun.clear()
        ended = self._take_result()
        if capturing and self._under_way is not None and not self._under_way.ours:
            self._cut_off()
        if self._worker is None:
            ended += self._begin(capturing=capturing)
        return ended

    def wait(self, timeout_s: float) -> list[RecoveryStatus]:
        """Wait until the recordings of this daemon's runs are recovered, or the time is up; return these."""
        deadline = time.monotonic() + timeout_s
        ended: list[RecoveryStatus] = []
        # One that was put off is not waited for: another process holds it.
        while any(task.ours and not task.tries for task in self._tasks.values()):
            ended += self.poll(capturing=True)
            if time.monotonic() > deadline:
                log.error("not recovered in time: %s", ", ".join(map(str, self._tasks)))
                break
            time.sleep(_POLL_S)
        return ended

    def close(self) -> None:
        """End the current recovery; a later daemon will find the recording. Idempotent."""
        self._cut_off()
        self._tasks.clear()

    def _queue(self, task: RecoveryTask) -> None:
        self._tasks[task.path] = task
        self._list(RecoveryStatus(path=task.path, state="waiting", text=task.why))

    def _list(self, status: RecoveryStatus) -> None:
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
        # A directory of thousands of other things must neither fill the log nor push the recordings out.
        for one in found.odd[:MOST_ODD]:
            log.warning("%s %s: %s", one.path, one.state, one.text)
            if one.path not in self._found:
                self._list(one)
        if len(found.odd) > MOST_ODD:
            log.warning("%d more like these in %s", len(found.odd) - MOST_ODD, self._directory)
        for path in found.open:
            # A search on a slow disk may meet what a run has begun since: that is not left by anybody.
            known = self._found.get(path)
            if (known is None or known.state in _MAY_COME_BACK) and path not in self._begun:
                self._queue(RecoveryTask(path))
        # What the journal names and the search met neither open nor odd is sealed by now.
        met = {*found.open, *(one.path for one in found.odd)}
        for path in [path for path in self._not_sealed if path not in met and path not in self._begun]:
            self.ended(path)

    def _begin(self, *, capturing: bool) -> list[RecoveryStatus]:
        """Begin the next recovery that is possible, of this daemon's runs first; return those that ended."""
        now_s = time.monotonic()
        able = [
            task
            for task in self._tasks.values()
            if task.not_before_s <= now_s and (task.ours or not capturing)
        ]
        ended: list[RecoveryStatus] = []
        for task in sorted(able, key=lambda task: not task.ours):
            hindered = hindrance(task)
            if hindered is None:
                try:
                    self._worker = Worker("salvage", salvage, task)
                except DeviceError as error:
                    hindered = RecoveryStatus(path=task.path, state="failed", text=str(error))
                else:
                    self._under_way = task
                    break
            ended += self._settle(task, hindered)
        return ended

    def _take_result(self) -> list[RecoveryStatus]:
        worker, task = self._worker, self._under_way
        if worker is None or task is None:
            return []
        death = worker.death  # read first, so that the last message of a dead process is seen
        message = worker.message()
        if message is None and death is None:
            return []
        self._worker = self._under_way = None
        _end(worker, _END_S)
        if isinstance(message, RecoveryStatus):
            return self._settle(task, message)
        why = message.error if isinstance(message, Failed) else death
        text = f"the recovering process: {why}"
        return self._settle(task, RecoveryStatus(path=task.path, state="failed", text=text))

    def _settle(self, task: RecoveryTask, status: RecoveryStatus) -> list[RecoveryStatus]:
        """Put a waiting recording off, or return its final status."""
        del self._tasks[task.path]
        self._list(status)
        if status.state == "waiting" and task.tries + 1 < MOST_TRIES:
            later = time.monotonic() + AGAIN_S
            self._tasks[task.path] = replace(task, tries=task.tries + 1, not_before_s=later)
            return []
        if status.state == "waiting":
            status = status.model_copy(update={"state": "left"})
            self._list(status)
        # One that is gone with acknowledged lines stays in the journal: its disk may only not be mounted.
        if status.state == "recovered" or (status.state == "gone" and not task.committed_lines):
            self.ended(status.path)
        level = logging.INFO if status.state == "recovered" else logging.WARNING
        text = status.text.removeprefix(RECOVERED)
        log.log(level, "%s %s: %s", status.path, status.state, text, extra=EACH)
        return [status]

    def _cut_off(self) -> None:
        # Its task stays in the list, so that the recovery is begun again later.
        worker, self._worker, self._under_way = self._worker, None, None
        if worker is not None:
            _end(worker, 0.0)


def _end(worker: Worker, within_s: float) -> None:
    """End the process, by force after a while, which does no harm: an interrupted recovery is repeated."""
    with contextlib.suppress(DeviceError):
        worker.end(time.monotonic() + within_s)
