"""The rig file changes while the real daemon records: allowed changes take effect, others are refused."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import signal
import socket
import subprocess
import termios
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_daemon import COMMAND, Answer, Daemon, write_rig
from waiting import until

from acquire.client import Client, State
from acquire.store import open_recording


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    with contextlib.closing(Daemon(tmp_path)) as running:
        yield running


def rewrite(daemon: Daemon, **replaced: str) -> None:
    """Rewrite the rig file with some lines replaced, or with the tables ``more`` added."""
    text = daemon.config.read_text()
    for key, value in replaced.items():
        if key == "more":
            text += f"\n{value}\n"
        else:
            text, count = re.subn(rf"^{key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
            assert count, key
    daemon.config.write_text(text)


def news_of(client: Client) -> str:
    """Return the latest news of a reload."""
    return [one.text for one in client.events(history=True, timeout_s=0) if one.kind == "reload"][-1]


def sentence(answer: Answer) -> str:
    return " ".join(answer.err.split())


def test_allowed_changes_take_effect_and_the_recording_continues(daemon: Daemon, tmp_path: Path) -> None:
    heard = tmp_path / "heard.jsonl"
    with daemon.client() as client:
        client.arm()
        client.start(tmp_path / "first.zarr")
        command = f'["sh", "-c", "cat >> {heard}; echo >> {heard}"]'
        rewrite(
            daemon,
            directory=f'"{tmp_path}"\nreserve_gb = 0.5',
            more=f'[hooks]\non = ["fault", "verdict"]\ncommand = {command}',
        )
        answer = daemon("reload")
        assert answer.code == 0, answer.err
        assert (
            "recording.reserve_gb = 0.5 from the next recording on, and for copies at once; it was 0.25"
            in answer.out
        )
        assert "hooks.on = ['fault', 'verdict'] at once; it was ['fault', 'loss', 'disk']" in answer.out
        assert client.setup().changed["recording.reserve_gb"] == 0.5
        until(lambda: (disk := client.status().disk) is not None and disk.reserve_bytes == 500_000_000)
        assert daemon("reload").out == f"{daemon.config} has not changed\n"
        client.stop()
        client.start(tmp_path / "second.zarr", duration_s=0.2)
        client.wait({State.ARMED}, 60)
        client.disarm()
        client.arm()
        until(lambda: heard.exists() and "the light's code is verified" in heard.read_text())
    first, second = (open_recording(tmp_path / f"{name}.zarr") for name in ("first", "second"))
    assert first.attrs["run_condition"] == second.attrs["run_condition"] == "GOOD"
    reserves = [one.attrs["config"]["recording"]["reserve_gb"] for one in (first, second)]
    assert reserves == [0.25, 0.5]
    (noted,) = [event.text for event in first.events if event.text.startswith("reload by")]
    assert noted.startswith("reload by the control socket: hooks.command = ")
    until(lambda: noted in daemon.log.read_text())


def test_a_reload_with_a_fixed_key_is_refused_as_a_whole(daemon: Daemon) -> None:
    with daemon.client() as client:
        client.arm()
        before = client.setup().config
        rewrite(
            daemon, stages="16", block_lines="32", more="[recording.retention]\nmax_gb = 5\n[code]\nseed = 7"
        )
        answer = daemon("reload")
        assert answer.code == 2
        said = sentence(answer)
        for key, new, old in (
            ("geometry.stages", 16, 8),
            ("stream.block_lines", 32, 64),
            ("code.seed", 7, 1),
        ):
            assert f"{key} = {new}, it was {old}" in said
        assert "recording.retention" not in said.partition("possible:")[0]
        assert "restart the daemon while it is idle" in said
        assert client.setup().config == before
        assert "nothing was changed: the daemon cannot change these while it runs" in news_of(client)
        assert client.status().state is State.ARMED
    refused = daemon("reload", "--json")
    assert refused.code == 2
    assert '"error"' in refused.out + refused.err


def test_a_broken_file_changes_nothing_and_is_reported(daemon: Daemon) -> None:
    with daemon.client() as client:
        before = client.setup().config
        whole = daemon.config.read_text()
        for text, why in (
            (whole.replace("[geometry]", "[geometry"), "is not TOML"),
            (whole + "\n[hooks]\non = ['storm']\n", "hooks.on"),
            (whole.replace("[recording]", "[recording]\nreserve_gb = 1e8"), "reserve_gb"),
        ):
            daemon.config.write_text(text)
            answer = daemon("reload")
            assert answer.code == 2
            assert why in sentence(answer)
            assert why in news_of(client)
        daemon.config.unlink()
        gone = daemon("reload")
        assert gone.code == 2
        assert "with which the service was started, does not exist" in sentence(gone)
        assert "put the file back" in sentence(gone)
        assert "rig-demo" not in gone.err  # the daemon cannot go on with another rig
        daemon.process.send_signal(signal.SIGHUP)
        until(lambda: "reload by SIGHUP" in (news := news_of(client)) and "does not exist" in news)
        assert client.setup().config == before
        assert client.status().state is State.IDLE
    until(lambda: "reload by SIGHUP: nothing was changed: " in daemon.log.read_text())


def test_sighup_reloads_the_page_and_the_log_level(daemon: Daemon) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def answers() -> bool:
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5).close()
        except urllib.error.HTTPError:
            return True  # it wants a token
        except OSError:
            return False
        return True

    with daemon.client() as client:
        whole = daemon.config.read_text()
        rewrite(daemon, more=f'[service]\nlog_level = "error"\n[web]\nport = {port}')
        daemon.process.send_signal(signal.SIGHUP)
        until(answers)
        assert "reload by SIGHUP: service.log_level = 'error', it was 'info' (at once); web = " in news_of(
            client
        )
        length = daemon.log.stat().st_size
        client.arm()
        client.disarm()
        said = daemon.log.read_bytes()[length:].decode()
        assert "idle → armed" not in said
        daemon.config.write_text(whole)
        assert daemon("reload").code == 0
        until(lambda: not answers())
        client.arm()
        until(lambda: "idle → armed" in daemon.log.read_text())
    assert daemon.end() == 0


@pytest.mark.parametrize("nohup", [False, True])
def test_a_terminal_that_is_closed_ends_its_daemon(tmp_path: Path, nohup: bool) -> None:
    """Nobody would see its messages; without a terminal, or with nohup, the same signal reloads the file."""
    terminal, end = os.openpty()
    log = tmp_path / "serve.log"

    def begin() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)
        # in either case: these tests may have been run by nohup
        signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL)

    with log.open("wb") as written:
        process = subprocess.Popen(
            [*COMMAND, "serve", "--config", str(write_rig(tmp_path))],
            stdin=end,
            stderr=written,
            start_new_session=True,
            preexec_fn=begin,  # noqa: PLW1509 - three system calls
        )
    os.close(end)
    try:
        until(lambda: "listening on" in log.read_text())
        os.close(terminal)
        if nohup:
            until(lambda: "reload by SIGHUP: the file has not changed" in log.read_text(), limit_s=60)
            process.terminate()
        assert process.wait(60) == 0
    finally:
        process.kill()
    assert f"{'SIGTERM' if nohup else 'SIGHUP'}: ending" in log.read_text()
