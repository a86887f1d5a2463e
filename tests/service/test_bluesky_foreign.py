"""Whose recording it is, while that cannot be read yet: asked of the recorder, with a client's answers."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from acquire.bluesky import Recorder, recorder
from acquire.bluesky.documents import Account
from acquire.client import State
from acquire.config import load_rig
from acquire.errors import PlaceError


class Client:
    """Reports another recording than the plan's, then none."""

    def __init__(self, other: Path) -> None:
        running = SimpleNamespace(path=other, first_line=0, committed_lines=0)
        self.statuses = [SimpleNamespace(state=State.RECORDING, recording=running)] * 2
        self.stops = 0

    async def status(self) -> Any:
        idle = SimpleNamespace(state=State.IDLE, recording=None)
        return self.statuses.pop() if self.statuses else idle

    async def stop(self) -> None:
        self.stops += 1


@pytest.mark.parametrize(("name", "stops"), [("run-2.zarr", 2), ("another.zarr", 0), ("sub/run-2.zarr", 0)])
def test_only_what_may_be_a_segment_of_its_recording_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, stops: int
) -> None:
    def opened(path: Path) -> Any:
        if path == tmp_path / "run.zarr":
            return SimpleNamespace(lines=7, attrs={}, first_line=0)
        raise PlaceError(f"{path} does not exist yet")

    async def stop() -> int:
        device = Recorder(tmp_path / "socket")
        device._client = client = Client(tmp_path / name)  # type: ignore[assignment]
        device._account = Account("r", load_rig("rig-demo"), tmp_path / "run.zarr", None)
        await device._stop_recording(disarm=False)
        return client.stops

    monkeypatch.setattr(recorder, "open_recording", opened)
    assert asyncio.run(stop()) == stops
