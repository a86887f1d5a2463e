"""The errors shown to a user, and the exit code that the command line returns for each.

::

    AcquireError                1  (a defect of ours, or a refused computation)
    ├── UsageError              2  the request cannot be fulfilled as it stands
    │   ├── ConfigError         2  a configuration file or value
    │   └── PlaceError          2  nothing of the kind is at a path or URL, or this user may not use it
    ├── NoDaemonError           3  no daemon answers on the control socket
    ├── StateError              4  the daemon cannot do this now
    │   └── BusyError           4  too many requests are waiting: the same one succeeds later
    ├── DeviceError             5  trigger, camera or host hardware
    │   ├── TriggerError        5
    │   ├── CameraError         5
    │   │   └── CameraLostError 5  it no longer answers; it may come back
    │   └── StoreError          5  a disk or a remote store fails, is full, or does not answer
    ├── DataError               6  a recording is damaged, or lines were lost; never anything else
    └── NumericsError           1  a computation produced numbers that are not finite

A message states what was asked; ``possible`` and ``hint`` add what is possible and what to try.
"""

from __future__ import annotations

from typing import Any

EXIT_INTERRUPTED = 130
"""128 + SIGINT, as shells report a program that Ctrl-C has ended."""


class AcquireError(Exception):
    """Base of the tree. ``str()`` gives the whole text: the message, what is possible, what to try."""

    exit_code = 1

    def __init__(self, message: str, *, possible: str = "", hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.possible = possible
        self.hint = hint

    def __str__(self) -> str:
        parts = [self.message]
        if self.possible:
            parts.append(f"possible: {self.possible}")
        if self.hint:
            parts.append(f"try: {self.hint}")
        return "; ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return the error for programs: on the control socket, and as ``--json``."""
        return {
            "error": type(self).__name__,
            "message": self.message,
            "possible": self.possible,
            "hint": self.hint,
            "exit_code": self.exit_code,
        }

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.message, self.possible, self.hint)


def _rebuild(cls: type[AcquireError], message: str, possible: str, hint: str) -> AcquireError:
    """Unpickle an error that crossed a process boundary; pickle cannot pass keyword-only arguments itself."""
    return cls(message, possible=possible, hint=hint)


def add_failure(error: BaseException, doing: str, later: Exception) -> None:
    """Add to ``error``, the only one that will be raised, what failed after it, while ``doing`` something.

    An AcquireError gets it in its message: notes are neither shown to users nor sent to other processes.
    """
    text = later.message if isinstance(later, AcquireError) else str(later)
    if not isinstance(error, AcquireError):
        error.add_note(f"{doing}: {text}")
    elif text not in error.message:
        error.message += f"; then, {doing}: {text}"
        error.args = (error.message,)


class UsageError(AcquireError):
    """The request cannot be fulfilled as it stands."""

    exit_code = 2


class ConfigError(UsageError):
    """A configuration file or one of its values; the message names the key."""


class PlaceError(UsageError):
    """A path or URL holds nothing of the kind that was asked for, or this user may not use it."""


class NoDaemonError(AcquireError):
    """No daemon answers on the control socket."""

    exit_code = 3


class StateError(AcquireError):
    """The daemon's state does not allow the command."""

    exit_code = 4


class BusyError(StateError):
    """As many requests as can wait are waiting already; the same one succeeds later."""


class DeviceError(AcquireError):
    """Trigger, camera or host hardware failed or refused."""

    exit_code = 5


class TriggerError(DeviceError):
    """The sync trigger failed or refused."""


class CameraError(DeviceError):
    """A camera failed or refused."""


class CameraLostError(CameraError):
    """A camera that was open no longer answers; it may come back."""


class StoreError(DeviceError):
    """A disk or a remote store fails, is full, or does not answer; no recorded line is known to be lost."""


class DataError(AcquireError):
    """A recording is damaged or incomplete, or lines were lost."""

    exit_code = 6


class NumericsError(AcquireError):
    """A computation produced numbers that are not finite, or would have."""
