"""The daemon in this process, over a scripted capture path: signals, and what is refused while it ends."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from fake_run import FakeRun, rig_config
from waiting import until

from acquire.client import Client
from acquire.daemon.connections import ApiServer
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.server import Daemon
from acquire.daemon.service import Service
from acquire.daemon.starting import is_one_starting, may_listen
from acquire.daemon.states import State
from acquire.daemon.troubles import MOST_LISTED, Troubles
from acquire.errors import EXIT_INTERRUPTED, NoDaemonError, StateError

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
        daemon = Daemon(Service(rig_config(path.parent), lambda _: run), endpoint)
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


def test_readiness_is_reported_once_requests_are_answered(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr("acquire.daemon.server.notify", told.append)
    before: list[str] = []
    begin = ApiServer.startup

    async def slow(self: ApiServer, sockets: list[socket.socket] | None = None) -> None:
        await asyncio.sleep(0.1)
        before.extend(told)
        await begin(self, sockets)

    monkeypatch.setattr(ApiServer, "startup", slow)
    assert live(path, FakeRun(), lambda client: until_in(client, State.IDLE)) == 0
    assert before == []
    assert told[:2] == ["READY=1", "WATCHDOG=1"]


def test_a_daemon_that_cannot_answer_is_never_ready(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told: list[str] = []
    monkeypatch.setattr("acquire.daemon.server.notify", told.append)

    async def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(ApiServer, "startup", fail)

    async def run() -> int:
        return await Daemon(Service(rig_config(path.parent), lambda _: FakeRun()), endpoint).run()

    with (
        caplog.at_level("INFO"),
        contextlib.closing(Endpoint(path)) as endpoint,
        pytest.raises(OSError, match="Too many open files"),
    ):
        asyncio.run(run())
    assert "READY=1" not in told
    assert "listening" not in caplog.text


def test_the_watchdog_is_fed_while_a_command_is_inside_its_limit(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An `arm` that takes its time is no reason to kill the daemon; one that exceeds its limit is."""
    monkeypatch.setattr("acquire.daemon.server.WATCHDOG_S", 0.02)
    pings: list[str] = []
    monkeypatch.setattr("acquire.daemon.server.notify", pings.append)
    patience_s = [300.0]
    monkeypatch.setattr(Service, "patience_s", property(lambda _: patience_s[0]))
    run = FakeRun()
    run.may_arm.clear()

    def script(client: Client) -> None:
        with ThreadPoolExecutor(1) as other:
            arming = other.submit(client.arm)
            try:
                until(lambda: client.status().busy is not None)
                before = len(pings)
                until(lambda: len(pings) > before + 5)
                patience_s[0] = 0.0
                silent = len(pings) + 1  # one may have been under way
                for _ in range(10):
                    client.status()
                    time.sleep(0.02)
                assert len(pings) <= silent
            finally:
                run.may_arm.set()
            arming.result()
        before = len(pings)
        until(lambda: len(pings) > before)

    assert live(path, run, script) == 0


def test_a_mark_is_taken_while_a_stop_is_waited_for(path: Path) -> None:
    run = FakeRun()
    run.seals_at_stop = False

    def script(client: Client) -> None:
        client.arm()
        client.start()
        with ThreadPoolExecutor(1) as other:
            stopping = other.submit(client.stop)
            try:
                client.wait({State.DRAINING}, 300)
                client.mark("meanwhile")
                assert not stopping.done()
            finally:
                run.seal()
            assert stopping.result().state is State.ARMED
        assert ("note", "mark", "meanwhile") in run.calls

    assert live(path, run, script) == 0


def test_a_daemon_that_is_starting_opens_and_closes_files(path: Path) -> None:
    """One that is gone when it is looked at does not mean that the daemon has ended."""
    code = (
        "print(flush=True)\nwhile True:\n    for file in [open('/dev/null') for _ in range(20)]: file.close()"
    )
    command = [sys.executable, "-c", code, "acquire", "serve"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as starting:
        try:
            assert starting.stdout is not None
            starting.stdout.readline()
            process = Path(f"/proc/{starting.pid}")
            assert all(may_listen(process, path) for _ in range(300))
        finally:
            starting.kill()


def test_a_client_waits_for_a_daemon_that_is_starting(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only while one is: a process of ours whose command line says so."""
    said: list[str] = []
    command = ["bash", "-c", "read", "acquire", "serve", "--socket", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as starting, ThreadPoolExecutor(1) as other:
        process = Path(f"/proc/{starting.pid}")
        until(lambda: may_listen(process, path), "its command line")
        assert not may_listen(process, path.with_name("another.sock"))
        assert is_one_starting(path)
        monkeypatch.setattr("acquire.client.blocking.STARTING_TIMEOUT_S", 0.5)  # there may be others
        waiting = other.submit(Client(path, said.append).status)
        until(lambda: said, "a word")
        starting.kill()
        with pytest.raises(NoDaemonError):
            waiting.result()
    assert "which is starting" in said[0]
    assert not may_listen(process, path)


def test_a_daemon_that_listens_elsewhere_is_not_waited_for(tmp_path: Path) -> None:
    """It is young, and nobody told it a socket: its configuration did."""
    elsewhere = tmp_path / "elsewhere.sock"
    listen = "import socket, sys; s = socket.socket(1); s.bind(sys.argv[3]); input(); s.listen(); input()"
    command = [sys.executable, "-c", listen, "acquire", "serve", str(elsewhere)]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as young:
        process = Path(f"/proc/{young.pid}")
        until(lambda: may_listen(process, tmp_path / "another.sock"), "its command line")
        assert young.stdin is not None
        young.stdin.write(b"\n")
        young.stdin.flush()
        until(lambda: not may_listen(process, tmp_path / "another.sock"), "its own socket")
        assert young.poll() is None
        young.kill()


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
