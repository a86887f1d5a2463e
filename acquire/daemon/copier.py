"""The process that copies recordings to where the rig wants them: `recording.upload_to`.

::

    Uploads ──▶ Copy, Reach                     the recording that grows, one shard at a time ─┐
    copier  ──▶ UploadStatus, Reached           the others, as long as it has nothing new ─────┴▶ Mirror

It stands back for those who capture, and never keeps one waiting: what is not copied yet lies on the local
disk. A store that fails is tried again after growing waits, and a copy that was cut off goes on where it was;
so the process may be ended, or killed, at any moment.
"""

from __future__ import annotations

import contextlib
import math
import select
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from acquire.daemon.messages import ErrorMessage, UploadStatus
from acquire.errors import AcquireError, PlaceError, UsageError
from acquire.processes.rank import EARLY, stand_back
from acquire.store import open_recording
from acquire.store.attributes import segment_of
from acquire.store.mirroring import LOOK_S, Mirror, only_copy
from acquire.store.opening import read_root
from acquire.store.refusals import refusal
from acquire.store.remote import RemoteSource, be_patient, check_url, url_below
from acquire.store.source import LocalSource

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.processes.worker import Mailbox

FIRST_WAIT_S = 1.0
MOST_WAIT_S = 60.0
"""Between two tries, from the first to the last."""
UNBORN_S = 30.0
"""A recording that is not there after so long will not come."""
IDLE_S = 60.0
"""Longest sleep; a message ends it."""
_NICE = 10


@dataclass(frozen=True, slots=True)
class Copy:
    """Copy the recording at ``path``. ``ours``: this daemon's runs write it, and it may be copied while it
    grows; of any other that is open it is not known what a crash has done to it before it is recovered.
    """

    path: Path
    ours: bool


@dataclass(frozen=True, slots=True)
class Reach:
    """Find out whether the store takes anything; ``number`` of the question."""

    number: int


@dataclass(frozen=True, slots=True)
class Reached:
    """It does, or ``error`` says why not; ``refused``: it was asked, and said no."""

    number: int
    error: ErrorMessage | None = None
    refused: bool = False


@dataclass(slots=True)
class Job:
    """One recording on its way."""

    path: Path
    ours: bool
    said: UploadStatus
    begun_s: float = field(default_factory=time.monotonic)
    grows: bool = True
    """As far as is known."""
    tries: int = 0
    """That failed, since the last that did not."""
    not_before_s: float = 0.0
    mirror: Mirror | None = None
    shards: int = 0
    """Copied by ``mirror``."""
    lock: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    def let_go(self) -> None:
        """The next try begins with a look at what is there."""
        self.mirror, self.shards = None, 0
        self.lock.close()


def wait_s(tries: int) -> float:
    """Until the next one, after so many that failed one after the other, and one more."""
    return min(math.ldexp(FIRST_WAIT_S, min(tries, 16)), MOST_WAIT_S)


def copy_recordings(mailbox: Mailbox, target: str, copies: tuple[Copy, ...]) -> None:
    """Life of the process, until its owner ends it; it begins with ``copies``."""
    stand_back(_NICE, EARLY)
    be_patient()
    with contextlib.suppress(UsageError):  # each try says so
        check_url(target)  # what it imports takes a moment
    mailbox.post(Reached(0))
    copier = Copier(mailbox, target)
    for copy in copies:
        copier.add(copy.path, ours=copy.ours)
    while True:
        copier.turn()


class Copier:
    """What is to be copied, and how far it is."""

    def __init__(self, mailbox: Mailbox, target: str) -> None:
        self._mailbox = mailbox
        self._target = target
        self._jobs: dict[Path, Job] = {}

    def turn(self) -> None:
        """Hear what is asked for, and copy one shard, or wait."""
        self._listen()
        now_s = time.monotonic()
        due = [job for job in self._jobs.values() if job.not_before_s <= now_s]
        if due:
            # The one that grows goes first: it is the one that retention waits for.
            self._serve(min(due, key=lambda job: not (job.ours and job.grows)))
            return
        until_s = min([now_s + IDLE_S, *(job.not_before_s for job in self._jobs.values())])
        waiting = select.poll()
        waiting.register(self._mailbox, select.POLLIN)
        waiting.poll(1000 * (until_s - now_s))

    def _listen(self) -> None:
        """Take what the owner says. Raises OwnerGone."""
        while (message := self._mailbox.take()) is not None:
            if isinstance(message, Copy):
                self.add(message.path, ours=message.ours)
            elif isinstance(message, Reach):
                self._mailbox.post(self._reach(message.number))

    def add(self, path: Path, *, ours: bool) -> None:
        """Copy a recording, too; one that waits is tried at once."""
        if (job := self._jobs.get(path)) is not None:
            job.ours, job.not_before_s = job.ours or ours, 0.0
            return
        said = UploadStatus(path=path, url=url_below(self._target, path), state="waiting")
        self._jobs[path] = Job(path, ours, said)

    def _reach(self, number: int) -> Reached:
        try:
            RemoteSource(self._target).prove()
        except UsageError as error:
            return Reached(number, ErrorMessage.of(error), refused=True)
        except OSError as error:
            told = refusal(self._target, error, "written")
            return Reached(number, ErrorMessage.of(told), refused=isinstance(told, PlaceError))
        return Reached(number)

    def _serve(self, job: Job) -> None:
        try:
            if job.mirror is not None or self._begin(job):
                assert job.mirror is not None
                self._advance(job, job.mirror)
        except PlaceError as error:  # a bucket, rights or credentials may come
            self._put_off(job, error.message, error.hint)
        except UsageError as error:
            self._end(job, state="refused", error=error.message, hint=error.hint)
        except AcquireError as error:
            self._put_off(job, error.message, error.hint)
        except OSError as error:
            self._put_off(job, f"{job.path}: {error.strerror or error}")

    def _begin(self, job: Job) -> bool:
        """Open the copy, if its time has come. Raises as `Mirror` does."""
        if not (job.path / "zarr.json").exists():
            # It is not made yet, or its disk is not there, or it was removed.
            young = job.ours and time.monotonic() - job.begun_s < UNBORN_S
            if not young and job.path.parent.is_dir():
                self._end(job, state="gone", error=f"{job.path} is not there any more", hint="")
            else:
                self._put_off(job, "" if young else f"{job.path.parent} is not there")
            return False
        # Open and not ours: what a crash has done to it is known once it is recovered. Copied now, it would
        # have to be copied again.
        if not job.ours and read_root(LocalSource(job.path))["attributes"].get("state") != "sealed":
            self._put_off(job, "it is open, and not recovered yet", f"acquire recover {job.path}")
            return False
        job.lock.enter_context(only_copy(job.path))
        job.mirror = Mirror(job.path, job.said.url, pause=self._listen)
        return True

    def _advance(self, job: Job, mirror: Mirror) -> None:
        done = mirror.step(most_shards=1)
        before, job.shards = job.shards, done.shards
        job.tries, job.grows = 0, mirror.grows
        facts = {"lines": done.lines, "waiting_lines": done.waiting_lines, "bytes": done.bytes}
        if done.sealed:
            # The first recording of a run lists its segments, this one by now: its root has to be copied
            # again.
            segment = segment_of(read_root(LocalSource(job.path))["attributes"])
            if segment is not None and (first := job.path.with_name(segment[0])).exists():
                self.add(first, ours=False)
                self._mailbox.post(self._jobs[first].said)
            self._end(job, state="copied", error="", hint="", **facts)
            return
        self._tell(job, state="copying", error="", hint="", **facts)
        if done.shards == before:
            job.not_before_s = time.monotonic() + LOOK_S

    def _end(self, job: Job, **facts: Any) -> None:
        del self._jobs[job.path]
        job.let_go()
        self._tell(job, **facts)

    def _put_off(self, job: Job, error: str = "", hint: str = "") -> None:
        job.let_go()
        job.not_before_s = time.monotonic() + wait_s(job.tries)
        job.tries += 1
        here: int | None = None
        with contextlib.suppress(AcquireError):
            here = open_recording(job.path).lines
        waiting = None if here is None else max(0, here - job.said.lines)
        self._tell(job, state="waiting", error=error, hint=hint, waiting_lines=waiting)

    def _tell(self, job: Job, **facts: Any) -> None:
        before, job.said = job.said, job.said.model_copy(update=facts)
        if job.said != before:
            self._mailbox.post(job.said)
