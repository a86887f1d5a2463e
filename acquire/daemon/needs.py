"""Interfaces of the objects given to the service: a run, its factory, and the proof of capacity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.config.recording import RecordingConfig
    from acquire.daemon.messages import ArmRequest, CalibrationStatus, CapacityStatus
    from acquire.daemon.options import LightCode
    from acquire.store import RecordingSpec
    from acquire.stream import Begin, CaptureStatus, Note
    from acquire.stream.ring import RingShape


class CapturePath(Protocol):
    """The part of `acquire.stream.Capture` that the service needs."""

    def start(self, begin: Begin) -> None:
        """Begin a recording; return once it exists. Raises UsageError or DataError if it cannot."""

    def note(self, kind: str, text: str) -> int:
        """List an event at the newest line, in every recording that holds the line, and return the line."""
        ...

    def extend(self, line: int) -> None:
        """Do not let the current recording end before ``line``, unless it is ending already."""

    def take_events(self) -> list[Note]:
        """Return the events of the trigger's inputs and of the lines since the last call, without marks."""
        ...

    def stop(self, reason: str) -> None:
        """End the recording at the newest line; `poll` reports when it is sealed. Idempotent."""

    def poll(self) -> CaptureStatus:
        """Return the current status; after `close`, the final one."""
        ...

    def ring_places(self) -> dict[str, tuple[str, RingShape]]:
        """Return arm → path and shape of its ring, for observers in other processes; empty once closed."""
        ...

    def close(self) -> None:
        """End everything; a current recording is sealed as interrupted. Idempotent."""


class ServiceRun(Protocol):
    """The part of `acquire.daemon.plan.Run` that the service needs."""

    run_id: str

    @property
    def capture(self) -> CapturePath:
        """The processes of this run."""
        ...

    @property
    def light(self) -> LightCode:
        """What the light follows: the rig's code, or constantly off or on."""
        ...

    @property
    def calibration(self) -> CalibrationStatus | None:
        """The calibration that its recordings carry; None if the rig names none."""
        ...

    def arm(self, progress: Callable[[str], object]) -> None:
        """Start cameras and trigger; on failure everything is undone and the first error raised."""

    def adopt(self, recording: RecordingConfig) -> None:
        """Use other settings for the next recording."""

    def spec(self) -> RecordingSpec:
        """Return the specification of the next recording, except its first line."""
        ...


class OpenRun(Protocol):
    """Creates the next run for a request to arm."""

    def __call__(self, request: ArmRequest) -> ServiceRun: ...


class Prove(Protocol):
    """The part of `acquire.daemon.proof.Proof` that the service needs."""

    def __call__(
        self, *, force: bool, progress: Callable[[str], object], fresh: bool = False
    ) -> CapacityStatus: ...
