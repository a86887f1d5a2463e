"""The daemon's automatic commands after its start, over a capture path that the test scripts."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

from fake_run import FakeRun, rig_config

from acquire.daemon.beginning import begin
from acquire.daemon.service import Service
from acquire.daemon.states import State
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable


def service_of(run: FakeRun, directory: Path) -> Service:
    settings = {"service.begin": "recording", "service.retry_s": 0.01}
    return Service(rig_config(directory, **settings), lambda _: run)


def begin_refused_twice(run: FakeRun, service: Service, name: str) -> None:
    """Carry out the automatic commands; the one of this name fails twice, as the run was told."""

    async def carry_out(command: Callable[[], None]) -> None:
        if run.names.count(name) == 2:
            run.refuse.clear()
        command()

    asyncio.run(begin(service.config.service, service, carry_out))


def test_a_refused_start_is_tried_again(tmp_path: Path) -> None:
    run = FakeRun(start=UsageError("the disk is not there"))
    service = service_of(run, tmp_path)
    begin_refused_twice(run, service, "start")
    assert run.names == ["arm", "start", "start", "start"]
    assert service.status().state is State.RECORDING


def test_a_command_ends_the_automatic_ones(tmp_path: Path) -> None:
    run = FakeRun(start=UsageError("the disk is not there"))
    service = service_of(run, tmp_path)

    async def carry_out(command: Callable[[], None]) -> None:
        try:
            command()
        finally:
            if "start" in run.names:
                service.disarm()

    asyncio.run(begin(service.config.service, service, carry_out))
    assert run.names == ["arm", "start", "close"]
    assert service.status().state is State.IDLE


def test_a_defect_is_listed_and_tried_again(tmp_path: Path) -> None:
    run = FakeRun(arm=OSError("No space left on device"))
    service = service_of(run, tmp_path)
    begin_refused_twice(run, service, "arm")
    assert run.names == ["arm", "arm", "arm", "start"]
    assert [one.times for one in service.status().troubles] == [2]
    assert service.status().state is State.RECORDING
