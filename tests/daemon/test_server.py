"""The daemon in this process, over a scripted capture path: signals, and what is refused while it ends."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from fake_run import FakeRun, rig_config
from waiting import until

from acquire.daemon.client import Client
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.server import Daemon
from acquire.daemon.service import Service
from acquire.daemon.states import State
from acquire.daemon.troubles import MOST_LISTED, Troubles
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


def until_in(client: Client, state: State) -> None:
    client.wait({state}, 60)


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
        until_in(client, State.DRAINING)
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
        until_in(client, State.DRAINING)
        os.kill(os.getpid(), signal.SIGINT)
        until(lambda: "close" in run.names, "the end")
        assert run.seen.condition == "INTERRUPTED"

    assert live(path, run, script) == EXIT_INTERRUPTED


def test_faults_are_seen_without_being_asked_for(path: Path) -> None:
    run = FakeRun()

    def script(client: Client) -> None:
        client.arm()
        run.see(fault="camera a is gone")
        until_in(client, State.FAULTED)
        assert client.status().fault == "camera a is gone"

    assert live(path, run, script) == 0


def test_a_defect_is_named_in_the_status_and_ends_nothing(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    looks = []

    def broken(_: Service) -> None:
        looks.append(1)
        raise ZeroDivisionError("oops\n\x1b")

    monkeypatch.setattr(Service, "supervise", broken)

    def script(client: Client) -> None:
        until(lambda: len(looks) > 2, "looks")
        (trouble,) = client.status().troubles
        assert trouble.text == r"supervision: ZeroDivisionError: oops\n\x1b"
        assert trouble.times > 1

    assert live(path, FakeRun(), script) == 0
    assert "Traceback" in caplog.text


def test_a_thread_that_dies_is_named_in_the_status() -> None:
    troubles = Troubles()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threading, "excepthook", troubles.in_thread)
        thread = threading.Thread(target=lambda: 1 // 0, name="reader")
        thread.start()
        thread.join()
    assert [one.text for one in troubles.statuses] == [
        "thread reader: ZeroDivisionError: integer division or modulo by zero"
    ]


def test_troubles_are_bounded() -> None:
    troubles = Troubles()
    for number in range(100):
        troubles.note("x" * 1000, ValueError(str(number) * 1000))
    assert len(troubles.statuses) == MOST_LISTED
