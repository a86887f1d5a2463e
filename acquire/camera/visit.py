"""Short access to one camera in a new process, like a grabber's, which is ended afterwards."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from acquire.processes.worker import Worker

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.camera.base import Camera, CameraOpener
    from acquire.processes.worker import Mailbox

T = TypeVar("T")
# A camera whose link is gone takes long to close.
_END_S = 30.0


@dataclass(frozen=True, slots=True)
class Armed:
    """The camera waits for line triggers."""


@dataclass(frozen=True, slots=True)
class Seen:
    """Result of the visit."""

    result: Any


def visit(
    opener: CameraOpener,
    look: Callable[..., T],
    *args: Any,
    timeout_s: float = 30.0,
    armed: Callable[[], object] | None = None,
) -> T:
    """Call ``look(camera, report_armed, *args)`` in a process that opens the camera; return its result or
    raise its error.

    If ``armed`` is given, ``look`` must call ``report_armed``, upon which ``armed`` is called here. Raises
    DeviceError if the process does not answer within ``timeout_s``.
    """
    worker = Worker("camera", _visit, opener, look, args)
    deadline = time.monotonic() + timeout_s
    try:
        if armed is not None:
            # `armed` may start the trigger, whose lines must not come before the camera waits for them.
            worker.expect(Armed, deadline)
            armed()
        seen: T = worker.expect(Seen, deadline).result
        return seen
    finally:
        worker.end(time.monotonic() + _END_S)


def _visit(mailbox: Mailbox, opener: CameraOpener, look: Callable[..., Any], args: tuple[Any, ...]) -> None:
    camera: Camera = opener()
    try:
        mailbox.post(Seen(look(camera, lambda: mailbox.post(Armed()), *args)))
    finally:
        camera.close()
