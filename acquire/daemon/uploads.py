"""Recordings are copied to a remote store automatically, while they grow: `recording.upload_to`.

::

    Service ──add──▶ Uploads ══ Copy, Reach ═▶ process: `copier` ──▶ <upload_to>/run.zarr
                        │   ◀═ UploadStatus, Reached ═══
                        └▶ .uploads-<rig>.json: what is not copied, for the next daemon

Nobody waits for it: recordings are written to the local disk, which is the spool, and retention leaves alone
what is not copied (`Retention.copied_to`). The process is ended by force when it does not end in time, and
replaced when it dies: a copy goes on where it was.
"""

from __future__ import annotations

import contextlib
import logging
import time
from typing import TYPE_CHECKING

from acquire.daemon.copier import MOST_WAIT_S, Copy, Reach, Reached, copy_recordings, wait_s
from acquire.daemon.journal import Journal
from acquire.daemon.messages import UploadStatus
from acquire.errors import AcquireError, ConfigError, DeviceError, UsageError
from acquire.processes.messages import Failed
from acquire.processes.worker import Worker
from acquire.store.attributes import upload_target
from acquire.store.opening import read_root
from acquire.store.remote import check_url, url_below
from acquire.store.source import LocalSource

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.config import RigConfig

MOST_LISTED = 32
"""Recordings that are copied, and that are not, of which the status tells: the latest."""
ANSWER_S = 20.0
"""How long arming waits for the store's answer, once the process that asks is there."""
START_S = 60.0
"""How long it waits for that process: an interpreter takes its time on a busy machine."""
_END_S = 3.0
_POLL_S = 0.02
_OVER = ("copied", "gone")

log = logging.getLogger("acquire.daemon")


def check_upload(config: RigConfig) -> None:
    """Raise ConfigError where the rig's `recording.upload_to` can never be reached from here."""
    url = config.recording.upload_to
    if url is None:
        return
    try:
        check_url(url)
    except UsageError as error:
        raise ConfigError(
            f"recording.upload_to: {error.message}", possible=error.possible, hint=error.hint
        ) from error


def _wants_copy(path: Path) -> bool:
    """The rig that recorded it copies its recordings."""
    try:
        return upload_target(read_root(LocalSource(path))["attributes"]) is not None
    except AcquireError:
        return False


class Uploads:
    """What is to be copied, and how far it is. For one thread; only `prove` and `close` wait.

    Parameters
    ----------
    target : URL below which recordings are copied; None: they are not
    journal : file that names what is not copied yet
    """

    def __init__(self, target: str | None = None, journal: Path | None = None) -> None:
        self._target = target
        self._journal = Journal(journal, "not_uploaded", "to be uploaded")
        self._found: dict[Path, UploadStatus] = {}
        self._noted = True
        """The journal names those that are left."""
        self._ours: set[Path] = set()
        self._worker: Worker | None = None
        self._born_s = 0.0
        self._deaths = 0
        """Within so short a time that something must be wrong."""
        self._not_before_s = 0.0
        self._awake = False
        """The process has said something."""
        self._questions = 0
        self._answer: Reached | None = None
        self.warning: str | None = None
        """Why copies may have to wait; for the status."""

    @property
    def statuses(self) -> list[UploadStatus]:
        """The latest of those that are copied, and of those that are not."""
        left = [one for one in self._found.values() if one.state not in _OVER]
        over = [one for one in self._found.values() if one.state in _OVER]
        return [*over, *left[-MOST_LISTED:]]

    @property
    def left(self) -> int:
        """Recordings that are not copied, those that are refused included."""
        return sum(one.state not in _OVER for one in self._found.values())

    def begin(self) -> None:
        """Start the process; it goes on with what an earlier daemon has not finished."""
        for path in self._journal.read():
            if self._target is None:
                log.warning("%s was not uploaded, and will not be: recording.upload_to is not set", path)
            else:
                log.info("%s was not uploaded: going on with it", path)
                self._expect(path)
        self._spawn()

    def add(self, path: Path) -> None:
        """Copy what a run writes; what is known already is passed over."""
        if path not in self._ours:
            self._ours.add(path)
            self.renew(path)

    def forget(self, path: Path) -> None:
        """A run begins to write there: what was there before is no more."""
        self._ours.discard(path)

    def renew(self, path: Path) -> None:
        """Bring a copy up to date, or begin it."""
        if self._target is not None:
            self._expect(path)
            self._note()
            self._post(Copy(path, path in self._ours))

    def recovered(self, path: Path) -> None:
        """A recording that was left open is sealed by now: copy it, if it says that it should be."""
        if path in self._found or _wants_copy(path):
            self.renew(path)

    def poll(self) -> None:
        """Hear how far it is; replace a process that has died."""
        worker = self._worker
        if worker is None:
            if time.monotonic() >= self._not_before_s:
                self._spawn()
            return
        death = worker.death  # asked first: what a process said last is still in its pipe then
        why = self._hear(worker)
        if death is not None or why is not None:
            self._worker = None
            with contextlib.suppress(DeviceError):
                worker.end(time.monotonic() + _END_S)
            self._wait_for_another(why or death or "")
        self._note()

    def prove(self, *, force: bool = False) -> None:
        """Ask the store, before a run is armed, whether it takes what will be copied.

        A store that says no will go on saying it: UsageError, unless ``force``. One that cannot be reached
        is a `warning` only: an experiment does not wait for a network, and the copy can.
        """
        self.warning = None
        if self._target is None:
            return
        answer = self._ask()
        if answer is not None and answer.refused and not force:
            told = answer.error.rebuild() if answer.error else UsageError(f"{self._target} refuses")
            raise UsageError(
                f"arm: recordings cannot be uploaded: {told.message}",
                possible=told.possible,
                hint=f"{told.hint or 'recording.upload_to'}; or arm --force",
            )
        if answer is not None and answer.error is not None:
            self.warning = answer.error.message
        elif answer is None and not any(one.state == "copying" for one in self._found.values()):
            self.warning = f"{self._target} has not answered for {ANSWER_S:g} s"
        if self.warning is not None:
            log.warning("recordings stay on this disk until they can be uploaded: %s", self.warning)

    def close(self) -> None:
        """End the process; a daemon that comes later goes on. Idempotent."""
        worker, self._worker = self._worker, None
        self._target = None
        if worker is not None:
            self._hear(worker)
            with contextlib.suppress(DeviceError):  # by force, which costs nothing
                worker.end(time.monotonic() + _END_S)
            self._note()

    def _expect(self, path: Path) -> None:
        assert self._target is not None
        before = self._found.get(path)
        if before is None or before.state in _OVER:
            self._tell(UploadStatus(path=path, url=url_below(self._target, path), state="waiting"))

    def _tell(self, said: UploadStatus) -> None:
        before = self._found.pop(said.path, None)  # the latest come last
        self._found[said.path] = said
        was_left = before is not None and before.state not in _OVER
        if was_left == (said.state not in _OVER):
            return
        self._noted = False
        over = [path for path, one in self._found.items() if one.state in _OVER]
        for path in over[:-MOST_LISTED]:
            del self._found[path]
            self._ours.discard(path)

    def _post(self, message: object) -> None:
        if self._worker is not None:
            self._worker.post(message)

    def _spawn(self) -> None:
        if self._target is None:
            return
        try:
            self._born_s = time.monotonic()
            self._awake = False
            left = [path for path, one in self._found.items() if one.state not in _OVER]
            copies = tuple(Copy(path, path in self._ours) for path in left)
            self._worker = Worker("uploads", copy_recordings, self._target, copies)
        except DeviceError as error:
            self._wait_for_another(str(error))

    def _hear(self, worker: Worker) -> str | None:
        """Take what the process says; why it ends, if it says so."""
        while (said := worker.message()) is not None:
            self._awake = True
            if isinstance(said, UploadStatus):
                self._heed(said)
            elif isinstance(said, Reached):
                self._answer = said
            elif isinstance(said, Failed):
                return str(said.error)
        return None

    def _heed(self, said: UploadStatus) -> None:
        before = self._found.get(said.path)
        if said.error and (before is None or (said.state, said.error) != (before.state, before.error)):
            log.warning("upload of %s %s: %s", said.path, said.state, said.error)
        elif said.state == "copied":
            log.info("upload of %s: %d lines are in %s", said.path, said.lines, said.url)
        if said.state in ("copying", "copied"):
            self.warning = None
        self._tell(said)

    def _wait_for_another(self, why: str) -> None:
        if time.monotonic() - self._born_s > MOST_WAIT_S:
            self._deaths = 0
        later_s = wait_s(self._deaths)
        self._deaths += 1
        self._not_before_s = time.monotonic() + later_s
        self.warning = f"the uploading process: {why}"
        log.error("%s; another takes its place in %g s", self.warning, later_s)

    def _ask(self) -> Reached | None:
        """The store's answer, or None when there is none in time."""
        self._questions += 1
        self._answer = None
        self._post(Reach(self._questions))
        deadline = time.monotonic() + START_S
        asked = False
        # The store's time counts from when the process that asks is there: it may be only starting.
        while self._answer is None or self._answer.number != self._questions:
            if self._awake and not asked:
                asked, deadline = True, min(deadline, time.monotonic() + ANSWER_S)
            if time.monotonic() > deadline:
                return None
            self.poll()
            time.sleep(_POLL_S)
        return self._answer

    def _note(self) -> None:
        """Write down what is not copied, where that has changed."""
        if not self._noted:
            self._noted = True
            self._journal.write(path for path, one in self._found.items() if one.state not in _OVER)
