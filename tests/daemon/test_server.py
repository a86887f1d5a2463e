"""The daemon in this process, over a scripted capture path: signals, and what is refused while it ends."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from fake_run import FakeRun, rig_config

from acquire.daemon.client import Client
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.server import Daemon
from acquire.daemon.service import Service
from acquire.daemon.states import State
from acquire.errors import EXIT_INTERRUPTED, StateError

Script = Callable[[Client], None]


@pytest.fixture
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("s") / "c.sock"


def live(path: Path, run: FakeRun, script: Script) -> int:
    """Run a daemon in this thread and its user in another; the daemon's exit code."""

    def user() -> None:
        try:
            with Client(path) as client:
                script(client)
        finally:  # whatever failed, the daemon must end
            run.seal()
            os.kill(os.getpid(), signal.SIGTERM)

    async def both() -> int:
        daemon = Daemon(Service(rig_config(path.parent), lambda: run), endpoint)
        running = asyncio.ensure_future(daemon.run())
        await asyncio.sleep(0)  # signals are taken from here on
        acting.append(threads.submit(user))
        return await running

    acting = []  # type: ignore[var-annotated]
    with ThreadPoolExecutor(1) as threads, contextlib.closing(Endpoint(path)) as endpoint:
        code = asyncio.run(both())
    acting[0].result()
    return code


def until(client: Client, state: State) -> None:
    client.wait({state}, 10)


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGTERM, 0), (signal.SIGHUP, 0), (signal.SIGINT, EXIT_INTERRUPTED)],
)
def test_while_it_ends_it_answers_but_obeys_no_more(path: Path, number: signal.Signals, code: int) -> None:
    run = FakeRun()
    run.seals_at_stop = False

    def script(client: Client) -> None:
        client.arm()
        client.start()
        os.kill(os.getpid(), number)
        until(client, State.DRAINING)
        with pytest.raises(StateError, match="the daemon is ending"):
            client.arm()

    assert live(path, run, script) == code
    assert run.names == ["arm", "start", "stop", "close"]
    assert not path.exists()


def test_second_signal_does_not_wait_for_lines(path: Path) -> None:
    run = FakeRun()
    run.seals_at_stop = False

    def script(client: Client) -> None:
        client.arm()
        client.start()
        os.kill(os.getpid(), signal.SIGINT)
        until(client, State.DRAINING)
        os.kill(os.getpid(), signal.SIGINT)
        deadline = time.monotonic() + 10
        while "close" not in run.names:
            assert time.monotonic() < deadline
        assert run.seen.condition == "INTERRUPTED"

    assert live(path, run, script) == EXIT_INTERRUPTED


def test_faults_are_seen_without_being_asked_for(path: Path) -> None:
    run = FakeRun()

    def script(client: Client) -> None:
        client.arm()
        run.see(fault="camera a is gone")
        until(client, State.FAULTED)
        assert client.status().fault == "camera a is gone"

    assert live(path, run, script) == 0
