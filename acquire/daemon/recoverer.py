"""The process that recovers one recording that its recorder did not seal; and the search for such recordings.

Anything that is not a recording, holds links, or was written on another machine is reported and left alone. A
recording that was prepared and not begun is removed, if no line of it was ever committed; everything else
stays, whatever is missing of it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.daemon.messages import RecoveryStatus
from acquire.errors import AcquireError, DataError, StateError
from acquire.processes.rank import EARLY, stand_back
from acquire.store import READABLE, Circumstances, recover
from acquire.store.files import DISK, locked
from acquire.store.host import has_run_on, is_here
from acquire.store.links import refuse_link, refuse_links
from acquire.store.listing import candidates
from acquire.store.opening import read_root
from acquire.store.rebuild import known_attributes, root_is_lost
from acquire.store.removal import Unborn, remove, shards_on_disk
from acquire.store.source import LocalSource
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

    from acquire.processes.worker import Mailbox

RECOVERED = "recovered: "
"""Beginning of a recovered recording's end reason."""
_NICE = 10
_ELSEWHERE = "it is open, and was not written on this machine: it may still be growing"


@dataclass(frozen=True, slots=True)
class RecoveryTask:
    """One recording to be recovered.

    ``ours``: left by a run of this daemon, for the reason ``why``. Its recorder had acknowledged
    ``committed_lines``, and was sent ``notes``: line, kind and text.
    """

    path: Path
    why: str = ""
    ours: bool = False
    committed_lines: int = 0
    tries: int = 0
    not_before_s: float = 0.0
    notes: tuple[tuple[int, str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Found:
    """Result of a search: recordings that are not sealed, and entries that cannot be recovered."""

    open: list[Path]
    odd: list[RecoveryStatus]


def search(directory: Path, recorded: Collection[Path] = ()) -> Found:
    """Find recordings that are not sealed, in a directory and among those ``recorded`` by earlier daemons.

    Raises OSError if the directory cannot be read.
    """
    paths = candidates(directory)
    known, found = set(recorded), Found([], [])
    for path in dict.fromkeys([*paths, *recorded]):
        try:
            _look_at(path, found, noted=path in known)  # by an earlier daemon, whatever its name
        except OSError as error:
            # One that may not be entered, or whose disk does not answer, hides none of the others.
            text = f"it cannot be looked at: {error.strerror}"
            found.odd.append(RecoveryStatus(path=path, state="left", text=text))
    return found


def _look_at(path: Path, found: Found, *, noted: bool) -> None:
    """Add a path to ``found``, unless it is a recording that is sealed. Raises OSError."""
    try:
        attributes = read_root(LocalSource(path))["attributes"]
    except AcquireError as error:
        if path.is_dir() and (noted or (root_is_lost(path) and known_attributes(path) is not None)):
            found.open.append(path)  # its root may be rebuilt
        elif noted and not os.path.lexists(path):
            text = (
                "it was being recorded when an earlier daemon ended, and is not there: is its disk mounted?"
            )
            found.odd.append(RecoveryStatus(path=path, state="gone", text=text))
        else:
            found.odd.append(RecoveryStatus(path=path, state="left", text=_without(path, error.message)))
        return
    if attributes.get("format") in READABLE and attributes.get("state") == "recording":
        found.open.append(path)


def _without(path: Path, message: str) -> str:
    """Return an error about a path for a text that begins with its name."""
    if path.is_symlink() and not path.exists():
        return f"it is a link to {path.readlink()}, which does not exist"
    rest = message.removeprefix(str(path))
    return message if rest == message else f"it{rest}" if rest.startswith(" ") else rest.removeprefix(": ")


def salvage(mailbox: Mailbox, task: RecoveryTask) -> None:
    """Main function of the process: one recovery, at low priority."""
    stand_back(_NICE, EARLY)
    mailbox.post(_salvage(mailbox, task))


def _salvage(mailbox: Mailbox, task: RecoveryTask) -> RecoveryStatus:
    path = task.path
    try:
        refuse_links(path)
        attributes = known_attributes(path)
        # Only then there is nothing to recover: a recording without a root may still hold all its lines.
        if attributes is None and not shards_on_disk(path):
            return _remove_unborn(task)
        if not task.ours and not is_here(attributes or {}):
            return RecoveryStatus(path=path, state="left", text=_ELSEWHERE)
        reason = f"{RECOVERED}{task.why}" if task.why else Circumstances().reason
        # Not `alone`: without locks nothing shows whether another process still writes the recording.
        known = Circumstances(reason, has_run_on(attributes or {}), alone=False, notes=task.notes)

        def look(_checked: int, _chunks: int) -> None:
            mailbox.take()  # raises OwnerGone, which ends the process, once nobody waits for the recovery

        done = recover(path, progress=look, known=known)
    except StateError as error:
        return RecoveryStatus(path=path, state="waiting", text=error.message)
    except FileNotFoundError:
        return RecoveryStatus(path=path, state="gone", text=_gone(task))
    except (AcquireError, OSError) as error:
        acknowledged = counted(task.committed_lines, "line of it", "was")
        lost = f"; {acknowledged} acknowledged" if task.committed_lines else ""
        return RecoveryStatus(path=path, state="failed", text=f"{error}{lost}")
    sealed = read_root(LocalSource(path))["attributes"]
    text = str(sealed["end_reason"])
    if done.lines < task.committed_lines:
        text += f"; of {counted(task.committed_lines, 'acknowledged line')} only {done.lines} on disk"
    for lost in done.tables_lost.values():
        text += f"; {lost}"
    if done.not_listed:
        text += f"; not listed in its first recording: {done.not_listed}"
    return RecoveryStatus(
        path=path, state="recovered", lines=done.lines, condition=sealed["run_condition"], text=text
    )


def _gone(task: RecoveryTask) -> str:
    if not task.committed_lines:
        return "it is not there; no line of it was committed"
    return (
        f"it is not there any more, and {counted(task.committed_lines, 'line of it', 'was')} acknowledged: "
        "was its disk unmounted, or the directory moved or removed?"
    )


def _remove_unborn(task: RecoveryTask) -> RecoveryStatus:
    """Remove a recording whose recorder was killed while preparing it: it has no line and no root."""
    if not task.path.is_dir():
        return RecoveryStatus(path=task.path, state="gone", text=_gone(task))
    if not task.ours:
        return RecoveryStatus(path=task.path, state="left", text="it holds no line and has no root")
    with locked(task.path, "removing", surely=True):
        remove(DISK, task.path, Unborn(task.committed_lines))
    text = "its recorder was killed before it had begun: no line was committed, and its files are removed"
    return RecoveryStatus(path=task.path, state="gone", lines=0, text=text)


def hindrance(task: RecoveryTask) -> RecoveryStatus | None:
    """Return the status of a recording that cannot be recovered now, or None."""
    path = task.path
    try:
        refuse_link(path, path)
        # Only a try, before a process is started for it: `recover` takes the lock again.
        with locked(path, "recovering", surely=True):
            return None
    except StateError as error:
        return RecoveryStatus(path=path, state="waiting", text=error.message)
    except FileNotFoundError:
        return RecoveryStatus(path=path, state="gone", text=_gone(task))
    except DataError as error:
        return RecoveryStatus(path=path, state="left", text=error.message)
    except OSError as error:
        return RecoveryStatus(path=path, state="failed", text=f"{path}: {error.strerror}")
