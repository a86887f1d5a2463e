"""What keeps a service in its place in the host: hooks, unit, alert rules."""

from __future__ import annotations

import configparser
import contextlib
import errno
import http.server
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
from fake_run import FakeRun, rig_config
from waiting import until

from acquire.cli.install_service import install_service
from acquire.config import builtin_directory, load_rig
from acquire.config.service import HooksConfig
from acquire.daemon import hooks as hooks_module
from acquire.daemon.facts import Health
from acquire.daemon.hooks import Hooks
from acquire.daemon.host import memory_bytes, needed_bytes
from acquire.daemon.messages import ArmRequest
from acquire.daemon.metrics import metrics_text
from acquire.daemon.news import NewsLog
from acquire.daemon.page import Page
from acquire.daemon.reload import changes, words
from acquire.daemon.service import Service
from acquire.daemon.setup import setup_of
from acquire.daemon.states import State
from acquire.daemon.unit import WATCHDOG_S, unit_text
from acquire.errors import ConfigError, UsageError
from acquire.trigger.transports.base import UDEV_HINT
from acquire.trigger.transports.usb import VENDOR


def until_written(path: Path, lines: int) -> list[dict[str, str]]:
    deadline = time.monotonic() + 300
    while not path.exists() or len(path.read_text().splitlines()) < lines:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_hook_receives_faults_losses_and_the_disk_and_nothing_else(tmp_path: Path) -> None:
    log, told = NewsLog(), tmp_path / "told"
    code = f"import sys; open({str(told)!r}, 'a').write(sys.stdin.read() + chr(10))"
    hooks = Hooks(HooksConfig(command=(sys.executable, "-c", code)), log, "rig")
    log.add("mark", "no")
    log.add("state", "armed", State.ARMED)
    log.add("loss", "arm a lost 5 lines: camera", level="error", lines=5)
    log.add("state", "fault: gone", State.FAULTED, level="error")
    log.add("state", "disarm", State.IDLE)
    found = until_written(told, 2)
    hooks.close()
    assert [one["text"] for one in found] == ["rig: arm a lost 5 lines: camera", "rig: fault: gone"]
    assert len(until_written(told, 2)) == 2


def test_a_hook_that_hangs_or_fails_is_given_up(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = NewsLog()
    hooks = [
        Hooks(HooksConfig(command=words, timeout_s=0.2), log, "rig")
        for words in (("sleep", "300"), ("false",), (str(tmp_path / "none"),), ("a\0b",))
    ]
    log.add("loss", "x", level="error")
    deadline = time.monotonic() + 300
    while not all(word in caplog.text for word in ("timed out", "exit code 1", "No such file", "null byte")):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    for one in hooks:
        one.close()


def test_a_hook_is_given_up_with_its_children(tmp_path: Path) -> None:
    log, noted = NewsLog(), tmp_path / "child"
    words = ("sh", "-c", f"sleep 3000 & echo $! > {noted}.new; mv {noted}.new {noted}; wait")
    hooks = Hooks(HooksConfig(command=words, timeout_s=1), log, "rig")
    log.add("loss", "arm a lost 5 lines: camera", level="error", lines=5)
    deadline = time.monotonic() + 300
    while not noted.exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    child = int(noted.read_text())
    while psutil.pid_exists(child) and psutil.Process(child).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    hooks.close()


@pytest.mark.filterwarnings("ignore:subprocess .* is still running:ResourceWarning")
def test_a_hook_that_cannot_be_ended_leaves_no_descriptor_behind(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As one that became another user. Its pipes stayed open for as long as it went on."""
    others: list[int] = []

    def refused(pid: int, number: int) -> None:
        others.append(pid)
        raise PermissionError(errno.EPERM, "Operation not permitted")

    killpg = os.killpg
    monkeypatch.setattr(os, "killpg", refused)
    before = psutil.Process().num_fds()
    try:
        for posts in (False, True):
            words = [sys.executable, "-c", "import time; time.sleep(300)"]
            monkeypatch.setattr(hooks_module, "START_S", 0.0)
            hooks_module._call("it", words, b"news" * 100_000, 0.2, posts=posts)
        assert caplog.text.count("hook it cannot be ended") == 2
        assert psutil.Process().num_fds() == before
    finally:
        for pid in others:
            killpg(pid, signal.SIGKILL)


def test_a_hook_stands_back(tmp_path: Path) -> None:
    """It may compute for as long as its timeout, in a session of its own."""
    log, told = NewsLog(), tmp_path / "told"
    code = f"import os; input(); open({str(told)!r}, 'a').write(str(os.getpriority(os.PRIO_PROCESS, 0)))"
    hooks = Hooks(HooksConfig(command=(sys.executable, "-c", code)), log, "rig")
    log.add("loss", "arm a lost 5 lines: camera", level="error", lines=5)
    until(lambda: told.exists() and told.read_text() != "")
    hooks.close()
    assert int(told.read_text()) == min(19, os.getpriority(os.PRIO_PROCESS, 0) + 10)


def test_the_page_is_in_the_session_of_the_daemon_but_not_interrupted_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one of its own, a kernel with autogroups gave it half of the processors, however nice it was."""
    words = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    monkeypatch.setattr(Page, "_command", lambda *_: words)
    page = Page(tmp_path / "c.sock")
    try:
        page.poll(rig_config(tmp_path, web={}))
        assert page.pid is not None
        assert os.getsid(page.pid) == os.getsid(0)
        assert os.getpgid(page.pid) == page.pid
    finally:
        page.close()


def test_a_webhook_gets_json() -> None:
    bodies: list[bytes] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            bodies.append(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None: ...

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        log = NewsLog()
        hooks = Hooks(HooksConfig(webhook=f"http://127.0.0.1:{server.server_port}/x"), log, "rig")
        log.add("disk", "the disk is full in 2 min", level="error")
        thread.join(300)
        hooks.close()
    assert json.loads(bodies[0])["text"] == "rig: the disk is full in 2 min"


def test_a_server_that_does_not_speak_http_ends_no_notifications(caplog: pytest.LogCaptureFixture) -> None:
    """As on a port of another service, or of https."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(300)
        log = NewsLog()
        hooks = Hooks(HooksConfig(webhook=f"http://127.0.0.1:{server.getsockname()[1]}/x"), log, "rig")
        for _ in range(2):
            log.add("loss", "x", level="error")
            connection, _ = server.accept()
            with connection:
                connection.recv(2**16)
                connection.sendall(b"SSH-2.0-x\r\n")
        hooks.close()
    assert caplog.text.count("BadStatusLine") == 2


def test_a_server_that_answers_byte_by_byte_is_given_up(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(300)
        log = NewsLog()
        url = f"http://127.0.0.1:{server.getsockname()[1]}/x"
        hooks = Hooks(HooksConfig(webhook=url, timeout_s=1), log, "rig")
        log.add("loss", "x", level="error")
        deadline = time.monotonic() + 300
        connection, _ = server.accept()
        # each byte comes in time
        with connection, contextlib.suppress(OSError):
            for byte in itertools.chain(b"HTTP/1.1 200 OK\r\nX: ", itertools.repeat(ord("x"), 60_000)):
                connection.sendall(bytes([byte]))
                time.sleep(0.05)
                assert time.monotonic() < deadline
        while "timed out after 1 s" not in caplog.text:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        hooks.close()


@pytest.mark.parametrize("url", ["ftp://x", "http://", "http://user:secret@host/"])
def test_webhooks_that_cannot_be_are_refused(url: str) -> None:
    with pytest.raises(ConfigError, match=r"hooks\.webhook"):
        load_rig("rig-demo", {"hooks.webhook": url})


@pytest.mark.parametrize(
    "url",
    [
        "https//chat/s3cret",
        "ftp://chat/s3cret",
        "http://chat:s3cret/x",
        "http://[chat/s3cret",
        "http://chat/s3 cret\n",
        "http://user:s3cret@chat/",
        ["http://chat/s3cret"],
    ],
)
def test_a_webhook_that_is_refused_is_not_quoted(url: object) -> None:
    """The error is logged by a reload, and is among the news that every page shows."""
    with pytest.raises(ConfigError, match=r"hooks\.webhook: ") as refused:
        load_rig("rig-demo", {"hooks.webhook": url})
    assert "s3" not in str(refused.value)


def test_a_webhook_with_a_letter_that_no_url_has_is_not_quoted_in_the_log(
    caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    log = NewsLog()
    hooks = Hooks(load_rig("rig-demo", {"hooks.webhook": "http://127.0.0.1:9/s3crét"}).hooks, log, "rig")
    log.add("loss", "x", level="error")
    until(lambda: "hook http://127.0.0.1:9/…: the URL has a letter" in caplog.text)
    hooks.close()
    assert "s3cr" not in caplog.text
    assert "Traceback" not in capfd.readouterr().err


def test_the_secret_in_a_webhook_s_path_stays_in_the_rig_file(caplog: pytest.LogCaptureFixture) -> None:
    """Whoever knows the path of a chat's webhook may write there; recordings are passed on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
    old, new = (load_rig("rig-demo", {"hooks.webhook": f"{url}/T0/{one}"}) for one in ("s3cret", "0ther"))
    assert old.model_dump(mode="json")["hooks"]["webhook"] == f"{url}/…"  # in recordings
    assert "s3cret" not in setup_of(old, "rig.toml").model_dump_json()
    (change,) = changes(old, new)  # it is noticed all the same
    assert words(change) == f"hooks.webhook = '{url}/…', it was '{url}/…'"
    log = NewsLog()
    hooks = Hooks(old.hooks, log, "rig")
    log.add("loss", "x", level="error")
    until(lambda: f"hook {url}/…: " in caplog.text)
    hooks.close()
    assert "s3cret" not in caplog.text


def unit_of(tmp_path: Path, *, user: bool) -> configparser.SectionProxy:
    rig = rig_config(tmp_path)
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(unit_text(rig, tmp_path / "my rig%.toml", user=user))
    return parser["Service"]


def test_the_unit_says_when_it_is_ready_and_what_it_may_not(tmp_path: Path) -> None:
    unit = unit_of(tmp_path, user=False)
    assert (unit["Type"], unit["WatchdogSec"], unit["Restart"]) == ("notify", str(WATCHDOG_S), "on-failure")
    assert unit["ExecStart"].endswith(f'-m acquire serve --config "{tmp_path}/my rig%%.toml"')
    assert unit["ExecReload"].endswith("-m acquire reload")  # its words and exit code are systemctl's
    assert str(tmp_path) in unit["ReadWritePaths"]
    assert float(unit["TimeoutStopSec"]) > rig_config(tmp_path).recording.seal_timeout_s
    assert (unit["OOMPolicy"], unit["OOMScoreAdjust"]) == ("continue", "-500")
    rings, scene = needed_bytes(rig_config(tmp_path))
    assert rings + scene < int(unit["MemoryLow"].removesuffix("M")) * 1e6 < memory_bytes()
    assert unit["NoNewPrivileges"] == "yes"
    assert f"NUMBA_CACHE_DIR=/var/cache/{unit['CacheDirectory']}" in unit["Environment"].split()
    assert "User" not in unit_of(tmp_path, user=True)


def test_the_unit_names_a_python_whose_path_has_a_space_or_a_dollar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/home/my user/$venv/bin/python")
    unit = unit_of(tmp_path, user=True)
    for key in ("ExecStart", "ExecReload"):
        assert unit[key].startswith('"/home/my user/$$venv/bin/python" -m acquire ')


@pytest.mark.needs_systemd
def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    install_service("rig-demo", directory=tmp_path)
    command = ["systemd-analyze", "verify", str(tmp_path / "acquire.service")]
    read = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (read.returncode, read.stderr) == (0, "")
    (tmp_path / "acquire.service").write_text("mine")
    with pytest.raises(UsageError, match="exists with different contents"):
        install_service("rig-demo", directory=tmp_path)


def test_the_udev_rule_alone_needs_no_rig_and_can_be_saved_as_it_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The advice named a file of the firmware's sources, which an installed package does not have."""
    install_service(None, udev=True)
    printed = capsys.readouterr()
    install_service(None, udev=True, directory=tmp_path)
    (rule,) = tmp_path.iterdir()
    assert printed.out == f"# /etc/udev/rules.d/{rule.name}\n{rule.read_text()}"
    assert f'ATTR{{idVendor}}=="{VENDOR:04x}"' in rule.read_text()
    assert "udevadm control --reload" in printed.err
    assert int(rule.name[:2]) < 73, "TAG uaccess has no effect from 73 on"
    assert "acquire install-service --udev" in UDEV_HINT


@pytest.mark.parametrize(("config", "udev"), [("rig-demo", True), (None, False)])
def test_a_service_needs_a_rig_and_the_rule_alone_takes_none(config: str | None, udev: bool) -> None:
    with pytest.raises(UsageError, match=r"--config.*possible: .*--udev"):
        install_service(config, udev=udev)


def test_every_alert_is_on_a_metric_that_there_is(tmp_path: Path) -> None:
    rules = (builtin_directory() / "prometheus-alerts.yml").read_text()
    named = set(re.findall(r"acquire_\w+", rules))
    assert len(named) >= 8
    service = Service(rig_config(tmp_path), lambda _: FakeRun())
    service.arm(ArmRequest())
    ledger = {"issued": 1, "preroll": 0, "stored": 1, "discarded": 0, "lost": {}, "waiting": 0, "pending": 0}
    check = {"verdict": "verified", "shift": 0, "checked_line": 1, "lapped": 0}
    trigger = {"clock_hz": 1, "uncertainty_ns": 1, "pulses": 1, "silent_s": 0.0, "answers": True}
    status = service.status().model_dump()
    for arm in status["arms"].values():
        arm.update(ledger={**ledger, "balanced": True}, check=check)
    numbers = ("free_bytes", "reserve_bytes", "bytes_per_s", "seconds_to_full")
    disk = {"directory": "/d", **dict.fromkeys(numbers, 1)}
    recording = {"path": "/d/x.zarr", **dict.fromkeys(("first_line", "recorded_lines", "committed_lines"), 0)}
    facts = {"trigger": trigger, "disk": disk, "recording": {**recording, "budget_lines": None}}
    full = type(service.status()).model_validate({**status, **facts})
    told = metrics_text(full, Health(level="good", sentence="", lost_lines=0, checks=[])).decode()
    assert [name for name in sorted(named) if f"\n{name}" not in told] == []
    service.disarm()
