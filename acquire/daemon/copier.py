"""The process that copies recordings to the rig's remote store: `recording.upload_to`.

::

    Uploads ──▶ Copy, Reach, Leave              the growing recording, one shard at a time ──┐
    copier  ──▶ UploadStatus, Reached           the others, while it has nothing new ────────┴▶ Mirror

It runs at low priority, and the capture never waits for it: lines that are not copied yet are on the local
disk. A store that fails is retried after growing waits, and an interrupted copy continues where it stopped,
so the process may be ended, or killed, at any moment.
"""

from __future__ import annotations

import contextlib
import math
import select
import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from acquire.daemon.messages import ErrorMessage, UploadStatus
from acquire.errors import AcquireError, PlaceError, StoreError, UsageError
from acquire.processes.rank import EARLY, stand_back
from acquire.store import open_recording
from acquire.store.attributes import segment_of
from acquire.store.files import DISK
from acquire.store.mirroring import AGAIN, LOOK_S, Mirror, only_copy
from acquire.store.opening import read_root
from acquire.store.refusals import refusal
from acquire.store.remote import RemoteSource, be_patient, check_url, shares_disk, url_below
from acquire.store.source import LocalSource

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.processes.worker import Mailbox

FIRST_WAIT_S = 1.0
MOST_WAIT_S = 60.0
"""First and longest wait between two tries."""
UNBORN_S = 30.0
"""A recording that does not exist after this time will not be created."""
IDLE_S = 60.0
"""Longest sleep; a message ends it earlier."""
_NICE = 10


@dataclass(frozen=True, slots=True)
class Copy:
    """Copy the recording at ``path``.

    ``ours``: written by this daemon's runs, and so may be copied while it grows. Any other open recording may
    have been damaged by a crash, and has to be recovered first.
    """

    path: Path
    ours: bool


@dataclass(frozen=True, slots=True)
class Reach:
    """Find out whether the store accepts files; ``number`` identifies the query."""

    number: int


@dataclass(frozen=True, slots=True)
class Leave:
    """Leave so many bytes of the recordings' disk free from now on; see `copy_recordings`."""

    reserve_bytes: int


@dataclass(frozen=True, slots=True)
class Reached:
    """The store accepts files, or ``error`` is why not; ``refused``: it answered, and refused."""

    number: int
    error: ErrorMessage | None = None
    refused: bool = False


@dataclass(slots=True)
class Job:
    """One recording to be copied."""

    path: Path
    ours: bool
    status: UploadStatus
    """As reported last."""
    begun_s: float = field(default_factory=time.monotonic)
    grows: bool = True
    """As far as is known."""
    tries: int = 0
    """Failed tries since the last success."""
    not_before_s: float = 0.0
    mirror: Mirror | None = None
    shards: int = 0
    """Shards copied by ``mirror``."""
    lock: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    def reset(self) -> None:
        """Close the copy: the next try checks what is at the target."""
        self.mirror, self.shards = None, 0
        self.lock.close()


def wait_s(tries: int) -> float:
    """Return the wait before the next try, after ``tries + 1`` consecutive failures."""
    # Limited before it is doubled: after a day without the store, the number would be too large for a float.
    return min(math.ldexp(FIRST_WAIT_S, min(tries, 16)), MOST_WAIT_S)


def copy_recordings(mailbox: Mailbox, target: str, copies: tuple[Copy, ...], reserve_bytes: int = 0) -> None:
    """Main function of the process, until its owner ends it; it begins with ``copies``.

    ``reserve_bytes`` of the recordings' disk are left free by copies on the same one.
    """
    stand_back(_NICE, EARLY)
    be_patient()  # before a store is opened, which reads the environment only then
    with contextlib.suppress(UsageError):  # each try reports it
        check_url(target)  # imports packages, which takes a moment
    mailbox.post(Reached(0))  # answers no query, but shows the owner that this process can
    copier = Copier(mailbox, target, reserve_bytes)
    for copy in copies:
        copier.add(copy.path, ours=copy.ours)
    while True:
        copier.turn()


class Copier:
    """Copies the recordings of its list."""

    def __init__(self, mailbox: Mailbox, target: str, reserve_bytes: int = 0) -> None:
        self._mailbox = mailbox
        self._reserve_bytes = reserve_bytes
        self._target = target
        self._jobs: dict[Path, Job] = {}

    def turn(self) -> None:
        """Read messages, and copy one shard, or wait."""
        self._read_messages()
        now_s = time.monotonic()
        due = [job for job in self._jobs.values() if job.not_before_s <= now_s]
        if due:
            # The growing recording comes first, since its retention waits for the copy.
            job = min(due, key=lambda job: not (job.ours and job.grows))
            try:
                if job.mirror is not None or self._begin(job):
                    assert job.mirror is not None
                    self._advance(job, job.mirror)
            # Nobody has to repeat a command: this process tries again by itself.
            except PlaceError as error:  # the bucket, permissions or credentials may still be created
                self._put_off(job, error.message, error.hint.removesuffix(AGAIN).rstrip("; "))
            except UsageError as error:
                self._end(job, state="refused", error=error.message, hint=error.hint)
            except AcquireError as error:
                self._put_off(job, error.message, error.hint.removesuffix(AGAIN).rstrip("; "))
            except OSError as error:
                self._put_off(job, f"{job.path}: {error.strerror or error}")
            return
        until_s = min([now_s + IDLE_S, *(job.not_before_s for job in self._jobs.values())])
        waiting = select.poll()
        waiting.register(self._mailbox, select.POLLIN)
        waiting.poll(1000 * (until_s - now_s))

    def _read_messages(self) -> None:
        """Read the owner's messages. Raises OwnerGone."""
        while (message := self._mailbox.take()) is not None:
            if isinstance(message, Copy):
                self.add(message.path, ours=message.ours)
            elif isinstance(message, Reach):
                self._mailbox.post(self._reach(message.number))
            elif isinstance(message, Leave):
                self._reserve_bytes = message.reserve_bytes

    def add(self, path: Path, *, ours: bool) -> None:
        """Add a recording to the list; one that is waiting already is tried at once."""
        if (job := self._jobs.get(path)) is not None:
            job.ours, job.not_before_s = job.ours or ours, 0.0
            return
        status = UploadStatus(path=path, url=url_below(self._target, path), state="waiting")
        self._jobs[path] = Job(path, ours, status)

    def _reach(self, number: int) -> Reached:
        try:
            RemoteSource(self._target).prove()
        except UsageError as error:
            return Reached(number, ErrorMessage.of(error), refused=True)
        except OSError as error:
            found = refusal(self._target, error, "written")
            return Reached(number, ErrorMessage.of(found), refused=isinstance(found, PlaceError))
        return Reached(number)

    def _begin(self, job: Job) -> bool:
        """Open the copy; return False if it has to wait, or will never come. Raises as `Mirror` does."""
        if not (job.path / "zarr.json").exists():
            # It does not exist yet, or its disk is not mounted, or it was removed.
            young = job.ours and time.monotonic() - job.begun_s < UNBORN_S
            if not young and job.path.parent.is_dir():
                self._end(job, state="gone", error=f"{job.path} is not there any more", hint="")
            else:
                self._put_off(job, "" if young else f"{job.path.parent} is not there")
            return False
        # An open recording of another daemon may be damaged until it is recovered. If it were copied now, it
        # would have to be copied again.
        if not job.ours and read_root(LocalSource(job.path))["attributes"].get("state") != "sealed":
            self._put_off(job, "it is open, and not recovered yet", f"acquire recover {job.path}")
            return False
        job.lock.enter_context(only_copy(job.path))
        job.mirror = Mirror(job.path, job.status.url, pause=partial(self._before_write, job))
        return True

    def _before_write(self, job: Job, size: int) -> None:
        """Read messages, which ends the copy soon after its owner has gone; refuse to use the reserve."""
        self._read_messages()
        # What recordings leave free is for their ends and recoveries, and not for copies of them.
        home = job.path.parent
        if shares_disk(self._target, home) and DISK.free_bytes(home) - size <= self._reserve_bytes:
            raise StoreError(
                f"{job.status.url} is on the recordings' disk, and {size} bytes more would leave less than "
                "recording.reserve_gb free",
                hint="free space there, or recording.upload_to on another disk",
            )

    def _advance(self, job: Job, mirror: Mirror) -> None:
        done = mirror.step(most_shards=1)
        before, job.shards = job.shards, done.shards
        job.tries, job.grows = 0, mirror.grows
        facts = {"lines": done.lines, "waiting_lines": done.waiting_lines, "bytes": done.bytes}
        if done.sealed:
            # The first recording of a run lists this segment by now: its root has to be copied again.
            segment = segment_of(read_root(LocalSource(job.path))["attributes"])
            if segment is not None and (first := job.path.with_name(segment[0])).exists():
                self.add(first, ours=False)
                self._mailbox.post(self._jobs[first].status)
            self._end(job, state="copied", error="", hint="", **facts)
            return
        self._report(job, state="copying", error="", hint="", **facts)
        # Nothing new yet: the next look comes when a growing recording may have grown.
        if done.shards == before:
            job.not_before_s = time.monotonic() + LOOK_S

    def _end(self, job: Job, **facts: Any) -> None:
        del self._jobs[job.path]
        job.reset()
        self._report(job, **facts)

    def _put_off(self, job: Job, error: str = "", hint: str = "") -> None:
        job.reset()
        job.not_before_s = time.monotonic() + wait_s(job.tries)
        job.tries += 1
        # Counted here, since no `Mirror` does while there is none: a recording grows while its store is away.
        here: int | None = None
        with contextlib.suppress(AcquireError):
            here = open_recording(job.path).lines
        waiting = None if here is None else max(0, here - job.status.lines)
        self._report(job, state="waiting", error=error, hint=hint, waiting_lines=waiting)

    def _report(self, job: Job, **facts: Any) -> None:
        before, job.status = job.status, job.status.model_copy(update=facts)
        if job.status != before:
            self._mailbox.post(job.status)
