"""Interfaces of the objects given to the service: a run, its factory, and the proof of capacity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.config.recording import RecordingConfig
    from acquire.daemon.messages import ArmRequest, CalibrationStatus, CapacityStatus
    from acquire.store import RecordingSpec
    from acquire.stream import Begin, CaptureStatus, Note
    from acquire.stream.ring import RingShape


class CapturePath(Protocol):
    """The part of `acquire.stream.Capture` that the service needs."""

    def start(self, begin: Begin) -> None: ...
    def note(self, kind: str, text: str) -> int: ...
    def extend(self, line: int) -> None: ...
    def take_events(self) -> list[Note]: ...
    def stop(self, reason: str) -> None: ...
    def poll(self) -> CaptureStatus: ...
    def ring_places(self) -> dict[str, tuple[str, RingShape]]: ...
    def close(self) -> None: ...


class ServiceRun(Protocol):
    """The part of `acquire.daemon.plan.Run` that the service needs."""

    run_id: str

    @property
    def capture(self) -> CapturePath: ...
    @property
    def calibration(self) -> CalibrationStatus | None: ...
    def arm(self, progress: Callable[[str], object]) -> None: ...
    def adopt(self, recording: RecordingConfig) -> None: ...
    def spec(self) -> RecordingSpec: ...


class OpenRun(Protocol):
    """Creates the next run for a request to arm."""

    def __call__(self, request: ArmRequest) -> ServiceRun: ...


class Prove(Protocol):
    """The part of `acquire.daemon.proof.Proof` that the service needs."""

    def __call__(
        self, *, force: bool, progress: Callable[[str], object], fresh: bool = False
    ) -> CapacityStatus: ...
