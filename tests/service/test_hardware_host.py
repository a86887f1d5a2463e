"""A capture host: what the daemon of a rig without simulated devices imports."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

from acquire.client import Client
from acquire.errors import AcquireError

OURS = "sim|recon|reconstruct|forward|evaluate|simulate"
OTHERS = "scipy|numba|matplotlib|PIL|jinja2|array_api_compat"
LABORATORY = re.compile(rf"\| +((?:acquire\.(?:{OURS})|{OTHERS})\b[\w.]*)$", re.MULTILINE)
TRIGGER = 'trigger={driver="serial", url="/dev/acquire-no-such-port"}'


def test_the_daemon_for_real_devices_does_not_import_the_simulator(tmp_path: Path) -> None:
    """Served, armed in vain (there are no cameras), asked, ended: no simulator, no solver, no plots."""
    socket, log = tmp_path / "s" / "a.sock", tmp_path / "imports.txt"
    socket.parent.mkdir(mode=0o700)
    words = ["serve", "--config", "rig-vt-4k5c-h100", "--socket", str(socket), "--set", TRIGGER]
    words += ["--set", f"recording.directory={str(tmp_path)!r}"]
    with log.open("w") as imports:
        daemon = subprocess.Popen(
            [sys.executable, "-X", "importtime", "-m", "acquire", *words], stderr=imports
        )
        try:
            deadline = time.monotonic() + 120
            while not socket.exists() and daemon.poll() is None and time.monotonic() < deadline:
                time.sleep(0.05)
            with Client(socket) as client:
                refused = _refusal(client)
                assert client.status().state.value == "idle"
            assert "GenTL" in refused or "trigger" in refused
        finally:
            daemon.send_signal(signal.SIGTERM)
            assert daemon.wait(120) == 0
    imported = log.read_text()
    assert "acquire.daemon.service" in imported, "the imports were not logged"
    assert LABORATORY.findall(imported) == []


def _refusal(client: Client) -> str:
    try:
        client.arm(force=True)  # however busy this host is: what is asked is what the devices lack
    except AcquireError as error:
        return str(error)
    raise AssertionError("a rig without cameras was armed")
