"""A capture path without processes: the test says what it sees."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from acquire.capacity.load import Load, recording_spec
from acquire.clock import ClockFit
from acquire.config import load_rig
from acquire.lines import ARMS
from acquire.store import RunCondition
from acquire.stream import CaptureStatus, Note, Window

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.config import RigConfig
    from acquire.config.recording import RecordingConfig
    from acquire.store import RecordingSpec
    from acquire.stream import Begin
    from acquire.stream.ring import RingShape

CALM = CaptureStatus(
    ring={arm: {"slots": 8, "fill": 1, "peak": 2, "drops": 0, "dropped_lines": 0} for arm in ARMS},
    lines={
        arm: {
            "delivered": 100,
            "preroll": 65,
            "discarded": 35,
            "lost": {"camera": 0},
            "recorded": 0,
            "missing": 0,
        }
        for arm in ARMS
    },
)


def rig_config(directory: Path, **settings: object) -> RigConfig:
    return load_rig("rig-demo", {"recording.directory": str(directory), **settings})


class FakeRun:
    """Records what it is told in ``calls``; ``refuse`` maps a call to the error it raises."""

    run_id = "fake-run"
    light = "rig"
    calibration = None

    def __init__(self, **refuse: Exception) -> None:
        self.calls: list[Any] = []
        self.refuse = refuse
        self.seen = CALM
        self.happened: list[Note] = []
        self.window = Window()
        self.may_arm = threading.Event()
        self.may_arm.set()
        self.seals_at_stop = True

    def see(self, **changes: Any) -> None:
        self.seen = replace(self.seen, **changes)

    def seal(
        self, lines: int = 500, reason: str = "stopped", condition: RunCondition = RunCondition.GOOD
    ) -> None:
        self.see(
            recording=False,
            done=True,
            recorded_lines=lines,
            committed_lines=lines,
            condition=condition,
            end_reason=reason,
        )

    def arm(self, progress: Callable[[str], object] = print) -> None:
        assert self.may_arm.wait(300)
        self._call("arm")
        self.seen = CALM

    @property
    def capture(self) -> FakeRun:
        return self

    def spec(self) -> RecordingSpec:
        return recording_spec(Load(8, "uint8", 33_333.0), ClockFit(90_000_000, 0, 0))

    def start(self, begin: Begin) -> None:
        self._call("start", begin.path, begin.lines)
        self.window = begin.window
        self.see(recording=True, first_line=40)

    def note(self, kind: str, text: str) -> int:
        self._call("note", kind, text)
        return 77

    def extend(self, line: int) -> None:
        self._call("extend", line)

    def take_events(self) -> list[Note]:
        happened, self.happened = self.happened, []
        return happened

    def stop(self, reason: str) -> None:
        self._call("stop", reason)
        if self.seals_at_stop:
            self.seal(reason=reason)

    def ring_places(self) -> dict[str, tuple[str, RingShape]]:
        return {}

    def poll(self) -> CaptureStatus:
        if "poll" in self.refuse and "close" not in self.names:
            raise self.refuse["poll"]
        return self.seen

    def adopt(self, recording: RecordingConfig) -> None:
        self._call("adopt", recording)

    def close(self) -> None:
        self._call("close")
        if self.seen.recording:
            self.see(recording=False, condition=RunCondition.INTERRUPTED, end_reason="the capture was closed")

    @property
    def names(self) -> list[str]:
        return [call[0] for call in self.calls]

    def _call(self, *call: Any) -> None:
        self.calls.append(call)
        if call[0] in self.refuse:
            raise self.refuse[call[0]]
