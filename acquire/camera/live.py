"""Live readings of one camera, repeated until it is closed, from a separate process."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acquire.camera.gauge import Gauge, Reading
from acquire.config.device import PIXEL_BITS
from acquire.errors import CameraError
from acquire.processes.messages import Failed, Ready
from acquire.processes.worker import Worker

if TYPE_CHECKING:
    from acquire.camera.base import Camera, CameraOpener
    from acquire.processes.worker import Mailbox

TURN_S = 0.2
"""Time between two readings."""
_WAIT_S = 0.05
# A camera whose link is gone takes long to close.
_END_S = 30.0


@dataclass(frozen=True, slots=True)
class ImagePart:
    """Part of a camera's image: an arm's columns, black and white. None: all columns, the format's white."""

    columns: tuple[int, int] | None = None
    black_dn: float = 0.0
    white_dn: int | None = None


@dataclass(frozen=True, slots=True)
class Readings:
    """Name of the view → reading."""

    of: dict[str, Reading]


class LiveCamera:
    """One camera, opened and armed in a process that ends with `close`. Line triggers must come from
    elsewhere.

    A camera may have several views, for example one with both arms' images.
    """

    def __init__(
        self, name: str, opener: CameraOpener, views: dict[str, ImagePart], timeout_s: float
    ) -> None:
        """Wait until the camera waits for lines. Raises CameraError, or DeviceError after ``timeout_s``."""
        self._worker = Worker(name, _look, opener, views)
        try:
            self.facts: dict[str, Any] = self._worker.expect(Ready, time.monotonic() + timeout_s).facts
        except BaseException:
            self.close()
            raise

    def take(self, timeout_s: float) -> dict[str, Reading]:
        """Return the next readings by view; empty if none came in time. Raises the camera's error."""
        message = self._worker.message(timeout_s)
        if isinstance(message, Failed):
            raise message.error
        if isinstance(message, Readings):
            return message.of
        # Last: a process that has died may have sent readings, or its error, before.
        if self._worker.death is not None:
            raise CameraError(
                f"{self._worker.name}: its process has ended: {self._worker.death}",
                hint="open the camera again; if it happens again, look for what ended it in the "
                "kernel's log (memory, or the camera's library)",
            )
        return {}

    def close(self) -> None:
        """Close the camera. Idempotent."""
        self._worker.end(time.monotonic() + _END_S)


def _look(mailbox: Mailbox, opener: CameraOpener, views: dict[str, ImagePart]) -> None:
    camera: Camera = opener()
    try:
        facts: dict[str, Any] = {"serial": camera.identify().serial, "settings": camera.settings()}
        gauges = {name: Gauge(view.black_dn, _white(view, facts["settings"])) for name, view in views.items()}
        camera.arm()
        mailbox.post(Ready(facts))
        due_s = time.monotonic() + TURN_S
        while True:
            mailbox.take()  # raises OwnerGone at the end
            if (block := camera.next_block(_WAIT_S)) is not None:
                lost = sum(loss.count for loss in block.losses)
                for name, view in views.items():
                    pixels = block.pixels if view.columns is None else block.pixels[:, slice(*view.columns)]
                    gauges[name].keep(gauges[name].look(pixels, block.flags, lost))
                camera.release(block)
            if time.monotonic() >= due_s:
                mailbox.post(Readings({name: gauge.take() for name, gauge in gauges.items()}))
                # Readings that a busy host has missed are left out, not made up for.
                due_s = max(due_s + TURN_S, time.monotonic())
    finally:
        camera.close()


def _white(view: ImagePart, settings: dict[str, Any]) -> int:
    """Return the white of the view, or of the camera's pixel format; ``Mono12p`` is packed Mono12."""
    if view.white_dn is not None:
        return view.white_dn
    pixel_format = str(settings.get("PixelFormat", ""))
    bits = PIXEL_BITS.get(pixel_format.removesuffix("p").removesuffix("Packed"))
    if bits is None:
        raise CameraError(
            f"the camera's PixelFormat is {pixel_format!r}, for which the white level is unknown",
            possible=", ".join(PIXEL_BITS),
            hint="use a rig file (--config), which states it",
        )
    return (1 << bits) - 1
