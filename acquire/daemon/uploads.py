"""Automatic copies of recordings to a remote store while they grow: `recording.upload_to`.

::

    Service ──add──▶ Uploads ══ Copy, Reach ═▶ process: `copier` ──▶ <upload_to>/run.zarr
                        │   ◀═ UploadStatus, Reached ═══
                        └▶ .uploads-<rig>.json: recordings not copied, for the next daemon

Nobody waits for it: recordings are written to the local disk, which is the spool, and retention does not drop
lines that are not copied (`Retention.copied_to`). The process is killed if it does not end in time, and
replaced if it dies: copies continue where they stopped.
"""

from __future__ import annotations

import contextlib
import logging
import time
from typing import TYPE_CHECKING

from acquire.daemon.copier import MOST_WAIT_S, Copy, Leave, Reach, Reached, copy_recordings, wait_s
from acquire.daemon.journal import Journal
from acquire.daemon.messages import UploadStatus
from acquire.errors import AcquireError, ConfigError, DeviceError, UsageError
from acquire.logs import EACH
from acquire.processes.messages import Failed
from acquire.processes.worker import Worker
from acquire.store.attributes import upload_target
from acquire.store.opening import read_root
from acquire.store.remote import check_url, url_below
from acquire.store.source import LocalSource
from acquire.text import counted

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.config import RigConfig

MOST_LISTED = 32
"""Number of latest recordings in the status, of those copied and of those not copied."""
ANSWER_S = 20.0
"""How long arming waits for the store's answer, once the process that queries it is there."""
START_S = 60.0
"""How long it waits for that process: an interpreter may start slowly on a busy machine."""
_END_S = 3.0
_POLL_S = 0.02
_OVER = ("copied", "gone")

log = logging.getLogger("acquire.daemon")


def check_upload(config: RigConfig) -> None:
    """Raise ConfigError if the rig's `recording.upload_to` can never be reached from here."""
    url = config.recording.upload_to
    if url is None:
        return
    try:
        check_url(url)
    except UsageError as error:
        raise ConfigError(
            f"recording.upload_to: {error.message}", possible=error.possible, hint=error.hint
        ) from error


class Uploads:
    """Recordings to be copied, and their progress. For one thread; only `prove` and `close` wait.

    Parameters
    ----------
    target : URL below which recordings are copied; None: they are not
    journal : file that lists recordings not copied yet
    reserve_bytes : bytes of the recordings' disk that copies on the same one leave free
    """

    def __init__(
        self, target: str | None = None, journal: Path | None = None, reserve_bytes: int = 0
    ) -> None:
        self._target = target
        self._reserve_bytes = reserve_bytes
        self._journal = Journal(journal, "not_uploaded", "to be uploaded")
        self._found: dict[Path, UploadStatus] = {}
        self._noted = True
        """The journal is up to date."""
        self._ours: set[Path] = set()
        self._worker: Worker | None = None
        self._born_s = 0.0
        self._deaths = 0
        """Deaths in quick succession."""
        self._not_before_s = 0.0
        self._awake = False
        """The process has sent a message."""
        self._queries = 0
        self._answer: Reached | None = None
        self.warning: str | None = None
        """Why copies may have to wait, for the status."""

    @property
    def statuses(self) -> list[UploadStatus]:
        """The latest recordings, of those copied and of those not copied."""
        left = [one for one in self._found.values() if one.state not in _OVER]
        over = [one for one in self._found.values() if one.state in _OVER]
        # Those that are over are few: `_list` forgets the oldest.
        return [*over, *left[-MOST_LISTED:]]

    @property
    def left(self) -> int:
        """Number of recordings that are not copied, including refused ones."""
        return sum(one.state not in _OVER for one in self._found.values())

    def begin(self) -> None:
        """Start the process, which continues the copies that an earlier daemon has not finished."""
        for path in self._journal.read():
            if self._target is None:
                log.warning("%s was not uploaded, and will not be: recording.upload_to is not set", path)
            else:
                log.info("%s was not uploaded: continuing", path, extra=EACH)
                self._expect(path)
        self._spawn()

    def add(self, path: Path) -> None:
        """Copy a recording of a run, unless it is known already."""
        # Without a target, nothing would ever take them out again.
        if self._target is not None and path not in self._ours:
            self._ours.add(path)
            self.renew(path)

    def forget(self, path: Path) -> None:
        """Note that a run begins to write there: an earlier recording there is gone."""
        self._ours.discard(path)

    def keep(self, reserve_bytes: int) -> None:
        """Set the bytes that copies on the recordings' disk leave free from now on."""
        self._reserve_bytes = reserve_bytes
        self._post(Leave(reserve_bytes))

    def renew(self, path: Path) -> None:
        """Bring a copy up to date, or begin it."""
        if self._target is not None:
            self._expect(path)
            self._note()
            self._post(Copy(path, path in self._ours))

    def recovered(self, path: Path) -> None:
        """Note that a recording is sealed after recovery: copy it if its configuration asks for that."""
        try:
            # It may have been written by another rig, or before this one named a store: its own root tells.
            wanted = (
                path in self._found or upload_target(read_root(LocalSource(path))["attributes"]) is not None
            )
        except AcquireError:
            return
        if wanted:
            self.renew(path)

    def poll(self) -> None:
        """Read messages; replace a process that has died."""
        worker = self._worker
        if worker is None:
            if time.monotonic() >= self._not_before_s:
                self._spawn()
            return
        death = worker.death  # read first, so that the last message of a dead process is seen
        why = self._read_messages(worker)
        if death is not None or why is not None:
            self._worker = None
            with contextlib.suppress(DeviceError):
                worker.end(time.monotonic() + _END_S)
            self._wait_for_another(why or death or "")
        self._note()

    def prove(self, *, force: bool = False) -> None:
        """Query the store, before a run is armed, whether it accepts files.

        A refusal is permanent: UsageError, unless ``force``. A store that cannot be reached is only a
        `warning`: an experiment does not wait for a network, but the copy can.
        """
        self.warning = None
        if self._target is None:
            return
        answer = self._query()
        if answer is not None and answer.refused and not force:
            error = answer.error.rebuild() if answer.error else UsageError(f"{self._target} refuses")
            raise UsageError(
                f"arm: recordings cannot be uploaded: {error.message}",
                possible=error.possible,
                hint=f"{error.hint or 'recording.upload_to'}; or arm --force",
            )
        if answer is not None and answer.error is not None:
            self.warning = answer.error.message
        # A process that is copying may read the query late, and shows that the store answers.
        elif answer is None and not any(one.state == "copying" for one in self._found.values()):
            self.warning = f"{self._target} has not answered for {ANSWER_S:g} s"
        if self.warning is not None:
            log.warning("recordings stay on this disk until they can be uploaded: %s", self.warning)

    def close(self) -> None:
        """End the process; a later daemon continues. Idempotent."""
        # Without a target, no further process is started.
        worker, self._worker = self._worker, None
        self._target = None
        if worker is not None:
            self._read_messages(worker)
            with contextlib.suppress(DeviceError):  # ended by force, which does no harm
                worker.end(time.monotonic() + _END_S)
            self._note()

    def _expect(self, path: Path) -> None:
        assert self._target is not None
        before = self._found.get(path)
        if before is None or before.state in _OVER:
            self._list(UploadStatus(path=path, url=url_below(self._target, path), state="waiting"))

    def _list(self, status: UploadStatus) -> None:
        before = self._found.pop(status.path, None)  # the latest come last
        self._found[status.path] = status
        # The journal lists what is left: it changes only when a recording is done, or begins anew.
        was_left = before is not None and before.state not in _OVER
        if was_left == (status.state not in _OVER):
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
            self._worker = Worker("uploads", copy_recordings, self._target, copies, self._reserve_bytes)
        except DeviceError as error:
            self._wait_for_another(str(error))

    def _read_messages(self, worker: Worker) -> str | None:
        """Read the process's messages; return why it ends, if it reports that."""
        while (message := worker.message()) is not None:
            self._awake = True
            if isinstance(message, UploadStatus):
                before = self._found.get(message.path)
                known = None if before is None else (before.state, before.error)
                if message.error and known != (message.state, message.error):
                    log.warning("upload of %s %s: %s", message.path, message.state, message.error)
                elif message.state == "copied":
                    text = "upload of %s: %s in %s"
                    lines = counted(message.lines, "line", "is")
                    log.info(text, message.path, lines, message.url, extra=EACH)
                if message.state in ("copying", "copied"):  # the store can be reached
                    self.warning = None
                self._list(message)
            elif isinstance(message, Reached):
                self._answer = message
            elif isinstance(message, Failed):
                return str(message.error)
        return None

    def _wait_for_another(self, why: str) -> None:
        # A process that worked for long is not one that fails at its start.
        if time.monotonic() - self._born_s > MOST_WAIT_S:
            self._deaths = 0
        later_s = wait_s(self._deaths)
        self._deaths += 1
        self._not_before_s = time.monotonic() + later_s
        self.warning = f"the uploading process: {why}"
        log.error("%s; it is replaced in %g s", self.warning, later_s)

    def _query(self) -> Reached | None:
        """Return the store's answer, or None if there is none in time."""
        # Numbered, since the answer to a query that timed out may still come.
        self._queries += 1
        self._answer = None
        self._post(Reach(self._queries))
        deadline = time.monotonic() + START_S
        is_timed = False
        # The store's time counts once the process is there, which may be only starting.
        while self._answer is None or self._answer.number != self._queries:
            if self._awake and not is_timed:
                is_timed, deadline = True, min(deadline, time.monotonic() + ANSWER_S)
            if time.monotonic() > deadline:
                return None
            self.poll()
            time.sleep(_POLL_S)
        return self._answer

    def _note(self) -> None:
        """Update the journal of recordings not copied, if it has changed."""
        if not self._noted:
            self._noted = True
            self._journal.write(path for path, one in self._found.items() if one.state not in _OVER)
