"""A capture path without processes: the test says what it sees."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from acquire.config import load_rig
from acquire.lines import ARMS
from acquire.store import RunCondition
from acquire.stream import CaptureStatus, Window
from acquire.stream.messages import Note

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.config import RigConfig
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

    def arm(self, tell: Callable[[str], object] = print) -> None:
        assert self.may_arm.wait(300)
        self._call("arm")
        self.seen = CALM

    def start(self, path: Path, lines: int | None, window: Window, *, resume: bool = False) -> Path:
        self._call("start", path, lines)
        self.window = window
        self.see(recording=True, first_line=40)
        return path.with_name("segment.zarr") if resume else path

    def mark(self, text: str) -> Note:
        self._call("mark", text)
        return Note(77, "mark", text)

    def note(self, kind: str, text: str) -> None:
        self._call("note", kind, text)

    def extend(self, line: int) -> None:
        self._call("extend", line)

    def events(self) -> list[Note]:
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
