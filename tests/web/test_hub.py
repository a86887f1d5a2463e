"""All pages share one subscription to the daemon, and what is made of it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from threading import Semaphore
from types import SimpleNamespace

import pytest
from fake_run import FakeRun, rig_config
from served import api

from acquire.client import AsyncClient
from acquire.daemon import states
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.service import Service
from acquire.web import live as live_module
from acquire.web.frames import HEAD
from acquire.web.hub import Hub
from acquire.web.live import RECORDING_TURN_S, TURN_S, Live


def test_pages_get_the_same_message_and_fewer_pictures_during_a_recording(tmp_path: Path) -> None:
    """For each page the state was encoded anew."""
    service, socket = Service(rig_config(tmp_path), lambda _: FakeRun()), tmp_path / "c.sock"

    async def until(condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(60):
            while not condition():
                await asyncio.sleep(0.01)

    async def follow() -> None:
        hub = Hub(socket, Live)
        running = asyncio.create_task(hub.run())
        client = AsyncClient(socket)
        try:
            await until(lambda: hub.connected)
            first = hub.state_message()
            assert hub.state_message() is first
            assert hub.live.turn_s == TURN_S
            await client.arm()
            await client.start(tmp_path / "r.zarr")
            await until(lambda: hub.is_recording)
            assert b'"recording"' in hub.state_message()
            assert b'"live_error":""' in hub.state_message()
            assert hub.state_message() is not first
            assert hub.live.turn_s == RECORDING_TURN_S
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    with contextlib.closing(Endpoint(socket)) as endpoint, api(service, endpoint):
        asyncio.run(follow())


def test_the_live_picture_is_tried_again_after_a_defect(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Its thread ended, and pages showed nothing until the server was started again."""
    monkeypatch.setattr(live_module, "RETRY_S", 0.01)
    tried = Semaphore(0)

    class Defective(Live):
        def _read(self, *_: object) -> None:
            tried.release()
            raise ValueError("what no test has seen")

    live, anything = Defective(lambda: None), SimpleNamespace(arms={"a": None})
    live.begin()
    try:
        live.show(anything, anything)  # type: ignore[arg-type]
        live.watch()
        assert all(tried.acquire(timeout=60) for _ in range(3))
        assert live.error == "what no test has seen"
        assert [record.message for record in caplog.records] == ["live picture"], "once, not at every try"
    finally:
        live.close()


def test_how_long_a_state_lasts_does_not_follow_a_clock_that_is_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page counted from the host's time at the change of state: years, or nothing for hours."""

    class Later(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:
            return datetime.now(tz) + timedelta(days=400)

    service, socket = Service(rig_config(tmp_path), lambda _: FakeRun()), tmp_path / "c.sock"

    async def follow() -> None:
        hub = Hub(socket, Live)
        running = asyncio.create_task(hub.run())
        client = AsyncClient(socket)
        try:
            monkeypatch.setattr(states, "datetime", Later)
            before_s = time.monotonic()
            await client.arm()
            async with asyncio.timeout(60):
                while hub.status is None or hub.status.state != "armed":
                    await asyncio.sleep(0.01)
            await asyncio.sleep(0.2)
            content = hub.state_message()
            head, _ = HEAD.unpack(content[: HEAD.size])
            told_s = json.loads(content[HEAD.size :][:head])["state"]["for_s"]
            assert 0.2 <= told_s <= time.monotonic() - before_s
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    with contextlib.closing(Endpoint(socket)) as endpoint, api(service, endpoint):
        asyncio.run(follow())
        assert service.status().since > datetime.now(UTC) + timedelta(days=399)
