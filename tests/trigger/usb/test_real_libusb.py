"""pyusb on the system's own libusb-1.0, on a bus simulated by umockdev; skipped if there is none."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from trigger_twins import wired_model
from umockdev_here import interpreter

from acquire.sim.twin_links import PtyTwin

HERE = Path(__file__).parent


@pytest.mark.needs_umockdev
def test_the_driver_runs_over_libusb_and_reports_an_unplugged_cable() -> None:
    paths = os.pathsep.join(map(str, (HERE.parent, HERE.parents[1], HERE.parents[2])))
    with wired_model() as model:
        twin = PtyTwin(model)
        script = [sys.executable, HERE / "drive_usb.py"]
        with subprocess.Popen(
            ["umockdev-wrapper", interpreter(), HERE / "mock_bus.py", twin.path, *script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": paths},
        ) as program:
            who = json.loads(program.stdout.readline())
            done = json.loads(program.stdout.readline())
            twin.close()
            program.stdin.write("go on\n")
            program.stdin.flush()
            end = json.loads(program.stdout.readline())
            assert program.wait(300) == 0
    assert who == {"backend": "usb.backend.libusb1", "device": "0000000000001234"}
    assert done["tagged"] == list(range(0, done["lines"], 16))
    assert (done["pulses"], done["tags_missing"], done["tag_lost"]) == (done["lines"], 0, 0)
    # The transfer under way may fail before the bus has noticed that nobody is there.
    said = ("usb 1209:0001 42 was unplugged", "usb 1209:0001 42 failed: [Errno 5]")
    assert any(text in end["error"] for text in said), end["error"]
