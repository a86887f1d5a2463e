"""The protocol of a camera: it is armed, delivers blocks of lines, and is disarmed.

A camera counts the lines that it delivers from 0 since it was armed. It has no trigger line numbers: the
grabber subtracts the sensor's depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

from acquire.lines import LineBlock


@dataclass(frozen=True, slots=True)
class CameraIdentity:
    """Identity of a camera: vendor, model, serial number, firmware version."""

    vendor: str
    model: str
    serial: str
    firmware: str


class LossCause(StrEnum):
    """Why the camera did not deliver lines; the words that are stored with a recording's gaps."""

    NO_BUFFER = "no_buffer"
    """The host had no free buffer: its reader was late."""
    INCOMPLETE = "incomplete"
    """The frame arrived without these lines."""
    ID_GAP = "id_gap"
    """Frame numbers jumped: lost on the link."""
    MISSED_TRIGGER = "missed_trigger"
    """The camera missed line triggers."""
    DEVICE_LOST = "device_lost"
    """The camera was away, and was opened again."""


@dataclass(frozen=True, slots=True)
class CameraLoss:
    """``count`` lines lost for one cause."""

    cause: LossCause
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class CameraBlock(LineBlock):
    """Consecutive lines as delivered; valid until released.

    ``first_line`` counts since arm, gaps included; ``pixels`` is (line, pixel), uint8 or uint16;
    ``flags`` is (line) uint16 of LineFlag. ``losses`` explains, in order, the lines that are missing just
    before the first; ``time_ns`` is the camera's own clock at the first line, if it has stamps.
    """

    losses: tuple[CameraLoss, ...] = ()
    time_ns: int | None = None


class Camera(Protocol):
    """One camera, opened and set. Calls are bounded in time and raise CameraError."""

    def identify(self) -> CameraIdentity:
        """Return vendor, model, serial number and firmware, as the camera states them."""
        ...

    def settings(self) -> dict[str, Any]:
        """Return the settings as read back from the camera, under their SFNC names.

        They are facts for JSON (no numbers of numpy), at least ``Width`` and ``PixelFormat``.
        """
        ...

    def arm(self) -> None:
        """Get ready for line triggers; the line count begins at 0."""
        ...

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """Return the next lines, or None if none came within ``timeout_s``.

        Raises CameraError ("not armed") if it is not armed.
        """
        ...

    def release(self, block: CameraBlock) -> None:
        """Give the block's memory back to the camera."""
        ...

    def disarm(self) -> None:
        """Stop delivering. Idempotent."""
        ...

    def statistics(self) -> dict[str, int]:
        """Return counters since arm: at least ``lines`` delivered and ``lost`` by the camera itself."""
        ...

    def close(self) -> None:
        """Close the device. Idempotent."""
        ...


class CameraOpener(Protocol):
    """Opens one camera in the process that calls it; picklable, to be passed to a grabber's process."""

    def __call__(self) -> Camera: ...
