"""Recordings that nobody sealed: the daemon recovers them by itself, in a process that stands back.

::

    a recorder was killed (`CaptureStatus.orphans`) ─┐
    found open when the daemon started ──────────────┴▶ Salvage ─▶ process: recover, one by one ─▶ status

What another process still writes is left to it: the lock of its directory tells. So is what another machine
wrote, and what lies where there are no locks. The process ends at once when a run is armed, unless it is
after what that run itself has left; a recovery that was cut off begins anew afterwards.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.daemon.messages import RecoveryStatus
from acquire.errors import AcquireError, DataError, DeviceError, PlaceError, StateError
from acquire.store import FORMAT, Circumstances, recover
from acquire.store.files import DISK, locked
from acquire.store.host import has_run_on, is_here
from acquire.store.opening import read_root
from acquire.store.source import LocalSource
from acquire.stream import Orphan
from acquire.stream.messages import Failed
from acquire.stream.process import Worker

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from acquire.stream.process import Mailbox

AGAIN_S = 5.0
"""Between two looks at a recording that another process holds."""
MOST_TRIES = 6
MOST_LISTED = 32
"""Recordings of which the status tells, the latest: more than one run can leave."""
RECOVERED = "recovered: "
"""How the end reason begins of a recording that was recovered."""
_NICE = 10
_END_S = 5.0
_POLL_S = 0.02

log = logging.getLogger("acquire.daemon")


@dataclass(frozen=True, slots=True)
class Task:
    """One recording to be recovered. ``ours``: this daemon's run has left it, ``why``."""

    path: Path
    why: str = ""
    ours: bool = False
    tries: int = 0
    not_before_s: float = 0.0


class Salvage:
    """What is to be recovered, and what became of it. For one thread; only `wait` and `close` wait."""

    def __init__(self, directory: Path) -> None:
        """``directory`` is searched for recordings that were left open, once `search` is called."""
        self._directory = directory
        self._tasks: dict[Path, Task] = {}
        self._found: dict[Path, RecoveryStatus] = {}
        self._worker: Worker | None = None
        self._under_way: Task | None = None
        self._searching: Future[list[Path]] | None = None

    @property
    def recoveries(self) -> list[RecoveryStatus]:
        """The latest; for the status."""
        return list(self._found.values())

    def search(self) -> None:
        """Look for recordings that a killed daemon has left; `look` will find them."""
        thread = ThreadPoolExecutor(1, "salvage")
        self._searching = thread.submit(open_recordings, self._directory)
        thread.shutdown(wait=False)

    def add(self, orphans: Iterable[Orphan]) -> None:
        """Recover what a run has left; what is known already is passed over."""
        for orphan in orphans:
            found = self._tasks.get(orphan.path)  # the search may have met it while it was being written
            if orphan.path not in self._found or (found is not None and not found.ours):
                log.warning("%s was not sealed: %s", orphan.path, orphan.why)
                self._queue(Task(orphan.path, orphan.why, ours=True))

    def look(self, *, capturing: bool = False) -> list[RecoveryStatus]:
        """Hear what is done, begin what is next; what came to an end since the last look.

        While ``capturing``, only what the run itself has left is recovered.
        """
        if self._searching is not None and self._searching.done():
            self._take_search(self._searching)
            self._searching = None
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
            ended += self.look(capturing=True)
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

    def _take_search(self, searching: Future[list[Path]]) -> None:
        try:
            paths = searching.result()
        except OSError as error:
            log.warning("%s cannot be searched for open recordings: %s", self._directory, error.strerror)
            return
        for path in paths:
            if path not in self._found:
                self._queue(Task(path))

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
            hindrance = _hindrance(task.path) or self._spawn(task)
            if hindrance is None:
                break
            ended += self._heed(task, hindrance)
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
        death = worker.death
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
            self._tasks[task.path] = Task(task.path, task.why, task.ours, task.tries + 1, later)
            return []
        if said.state == "waiting":
            said = said.model_copy(update={"state": "left"})
            self._tell(said)
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


def _hindrance(path: Path) -> RecoveryStatus | None:
    """What keeps a recording from being recovered now."""
    try:
        with locked(path, "recovering", surely=True):
            return None
    except StateError as error:
        return RecoveryStatus(path=path, state="waiting", text=error.message)
    except FileNotFoundError:
        return RecoveryStatus(path=path, state="recovered", lines=0, text=_UNBORN)
    except OSError as error:
        return RecoveryStatus(path=path, state="failed", text=f"{path}: {error.strerror}")


def open_recordings(directory: Path) -> list[Path]:
    """Recordings in a directory that are not sealed. Raises OSError."""
    return [path for path in sorted(directory.glob("*.zarr")) if _is_open(path)]


def _is_open(path: Path) -> bool:
    try:
        attributes = read_root(LocalSource(path))["attributes"]
    except (DataError, PlaceError):
        return False  # none, or none that can say what it is: `acquire ls` names it
    return (attributes.get("format"), attributes.get("state")) == (FORMAT, "recording")


def salvage(mailbox: Mailbox, task: Task) -> None:
    """Life of the process: one recovery, with less of the processors than others get."""
    os.nice(_NICE)
    mailbox.post(_salvage(mailbox, task))


def _salvage(mailbox: Mailbox, task: Task) -> RecoveryStatus:
    path = task.path
    try:
        if task.ours and not (path / "zarr.json").exists():
            return _remove_unborn(path)
        attributes = read_root(LocalSource(path))["attributes"]
        if not is_here(attributes):
            return RecoveryStatus(path=path, state="left", text=_ELSEWHERE)
        reason = f"{RECOVERED}{task.why}" if task.why else Circumstances().reason
        known = Circumstances(reason, committed_intact=has_run_on(attributes), alone=False)
        done = recover(path, progress=lambda *_: _ask(mailbox), known=known)
    except StateError as error:
        return RecoveryStatus(path=path, state="waiting", text=error.message)
    except (AcquireError, OSError) as error:
        return RecoveryStatus(path=path, state="failed", text=str(error))
    sealed = read_root(LocalSource(path))["attributes"]
    return RecoveryStatus(
        path=path,
        state="recovered",
        lines=done.lines,
        condition=sealed["run_condition"],
        text=str(sealed["end_reason"]),
    )


def _ask(mailbox: Mailbox) -> None:
    """Ends the process, by an exception, once its owner has gone."""
    mailbox.take()


_ELSEWHERE = "open, and not written on this machine, where it could be seen whether it still is"
_UNBORN = "its recorder was killed before it had begun: there is nothing of it"


def _remove_unborn(path: Path) -> RecoveryStatus:
    """Its recorder was killed while it made it: no line is in it, and it was never a recording."""
    if path.is_dir():
        with locked(path, "removing", surely=True):
            DISK.remove_tree(path)
    return RecoveryStatus(path=path, state="recovered", lines=0, text=_UNBORN)
