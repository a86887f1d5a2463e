"""The commands against a device behind a real pseudo-terminal."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from trigger_twins import SocketTwin, wired_model

from acquire.codes import prbs
from acquire.config.device import TriggerConfig
from acquire.sim.twin_links import PtyTwin
from acquire.trigger import registers as r
from acquire.trigger.driver import TriggerDriver
from acquire.trigger.transports.serial import SerialTransport


@pytest.fixture
def port() -> Iterator[str]:
    with wired_model() as model:
        twin = PtyTwin(model)
        yield twin.path
        twin.close()


def acquire(*arguments: str, code: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "acquire", "trigger", *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout if code == 0 else done.stderr


def test_a_run_by_hand(port: str) -> None:
    where = ("--url", port, "--json")
    facts = json.loads(acquire("info", *where))
    assert (facts["board"], facts["state"], facts["substeps"]) == ("model", "IDLE", [1, 2, 3, 6])
    alone = ("--set", "trigger.watchdog_s=0", "--run-id", "mine")  # the next command may take its time
    armed = json.loads(acquire("arm", *where, *alone))
    assert (armed["state"], armed["lines"], armed["utc_ns_at_tick_0"]) == ("ARMED", 0, None)
    started = json.loads(acquire("arm", *where, *alone, "--start"))
    assert started["state"] == "RUNNING"
    assert started["utc_ns_at_tick_0"] > 1e18
    tags = [json.loads(line) for line in acquire("monitor", *where, "--tags", "5").splitlines()]
    assert len(tags) == 5
    assert all(tag["code_index"] == 3 * tag["line"] for tag in tags)
    assert "another one runs" in acquire("arm", "--url", port, code=5)
    assert json.loads(acquire("stop", *where))["lines"] > 1000
    assert json.loads(acquire("info", "--port", port, "--json"))["end_reason"] == "STOPPED"
    assert "no run is armed" in acquire("monitor", "--url", port, code=5)


def test_a_run_without_host_requests_ends(port: str) -> None:
    started = json.loads(
        acquire("arm", "--url", port, "--json", "--start", "--set", "trigger.watchdog_s=1e-3")
    )
    assert started["watchdog_s"] == 1e-3
    facts = json.loads(acquire("info", "--url", port, "--json"))
    assert (facts["state"], facts["end_reason"]) == ("ENDED", "WATCHDOG")
    assert facts["lines"] >= 1e-3 / 30e-6


def test_a_run_is_monitored_to_its_end() -> None:
    settings = {
        "line_budget": "5000",
        "watchdog_s": "0",
        "tag_every_lines": "1000",
        "external_start": "'rising'",
    }
    with wired_model() as model, closing(SocketTwin(model)) as twin:
        changes = [word for key, value in settings.items() for word in ("--set", f"trigger.{key}={value}")]
        acquire("arm", "--url", twin.url, *changes)
        heard = model.frames_heard
        command = [sys.executable, "-m", "acquire", "trigger", "monitor", "--url", twin.url, "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as monitor:
            deadline = time.monotonic() + 300
            while model.frames_heard < heard + 3:
                assert time.monotonic() < deadline
                time.sleep(0.01)
            model.external_edge()
            tags = [json.loads(line) for line in monitor.communicate(timeout=300)[0].splitlines()]
        assert monitor.returncode == 0
    assert [(tag["line"], tag["flags"]) for tag in tags] == [
        (0, "LINE+FIRST+EXTERNAL"),
        *((line, "LINE") for line in (1000, 2000, 3000, 4000)),
        (4999, "LAST+BUDGET"),
    ]


def test_a_code_is_loaded_from_text_or_array_and_used(port: str, tmp_path: Path) -> None:
    bits = prbs(15, 3, 0, 1000)
    (tmp_path / "code.txt").write_text("\n".join("".join(map(str, row)) for row in bits.reshape(10, 100)))
    np.save(tmp_path / "code.npy", bits)
    crcs = set()
    for name in ("code.txt", "code.npy"):
        facts = json.loads(acquire("load", str(tmp_path / name), "--url", port, "--json"))
        assert (facts["bits"], facts["ones"]) == (1000, int(bits.sum()))
        crcs.add(facts["crc"])
    assert len(crcs) == 1
    armed = json.loads(acquire("arm", "--memory", "--url", port, "--json"))
    assert (armed["state"], armed["code_checked"]) == ("ARMED", True)
    (tmp_path / "bad.txt").write_text("0123")
    assert "does not hold bits" in acquire("load", str(tmp_path / "bad.txt"), "--url", port, code=2)


@pytest.mark.usefixtures("locks_of_the_host")
def test_self_test_and_refusals(port: str) -> None:
    assert "passed" in acquire("selftest", "--url", port)
    assert "no checked code" in acquire("arm", "--memory", "--url", port, code=5)
    too_short = acquire("arm", "--url", port, "--set", "geometry.substeps=4", code=5)
    assert "possible: 1, 2, 3, 6" in too_short
    held = SerialTransport(port, 3_000_000)
    assert "is in use by process" in acquire("info", "--url", port, code=5)
    held.close()
    assert "/dev/ttyNONE is not there" in acquire("info", "--url", "/dev/ttyNONE", code=5)
    assert "Connection refused" in acquire("info", "--url", "socket://127.0.0.1:1", code=5)


def test_the_demo_rig_has_a_trigger_as_well() -> None:
    assert "sync trigger (model)" in acquire("info")


def held(port: str, bits: int) -> tuple[str, dict[r.Register, int]]:
    """The code memory's first bits, and the configuration, as the device has them."""
    driver = TriggerDriver(partial(SerialTransport, port, 3_000_000), TriggerConfig())
    try:
        return "".join(map(str, driver.device().read_code(bits))), driver.device().configuration()
    finally:
        driver.release()


def test_square_waves_for_an_oscilloscope(port: str) -> None:
    facts = json.loads(acquire("square", "--url", port, "--seconds", "0.1", "--json"))
    assert facts["light_hz"] == pytest.approx(100e3 / 6)
    assert facts["lines"] > 1000
    bits, registers = held(port, 6)
    assert (bits, registers[r.CODE_LENGTH]) == ("111000", 6)
    assert r.CODE_SOURCE.kind.of(registers[r.CODE_SOURCE]) == r.Source.MEMORY
    assert "possible: 1 to 262144" in acquire("square", "--url", port, "--substeps", "262145", code=2)


def test_the_light_blinks_for_the_eye_until_ctrl_c(port: str) -> None:
    fast = ("--set", "trigger.clock_hz=90_000_000", "--set", "trigger.substep_ticks=50")
    command = [sys.executable, "-m", "acquire", "trigger", "blink", "--url", port, "--hz", "1", *fast]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as blinking:
        assert blinking.stderr is not None
        assert "until Ctrl-C" in blinking.stderr.readline()
        blinking.send_signal(signal.SIGINT)
        out = blinking.communicate(timeout=300)[0]
    assert (blinking.returncode, "1 Hz: 500 ms lit, 500 ms dark" in out) == (0, True)
    bits, registers = held(port, 1 << 19)
    half = registers[r.CODE_LENGTH] // 2
    assert 2 * half * registers[r.SUBSTEP_CLOCKS] == 90_000_000  # a second, in sub-steps that fit
    assert registers[r.SUBSTEP_CLOCKS] == 4 * 50
    assert bits[: 2 * half] == "1" * half + "0" * half
    assert "900000 Hz" in acquire("blink", "--url", port, "--hz", "1e8", *fast, code=2)
