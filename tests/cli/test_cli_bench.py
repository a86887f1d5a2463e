"""`acquire bench` at a load that every host sustains."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from acquire.config import load_rig

COMMAND = str(Path(sys.executable).with_name("acquire"))


def test_bench_reports_its_trials_and_leaves_nothing_behind(tmp_path: Path) -> None:
    ended = subprocess.run(
        [COMMAND, "bench", "--out", str(tmp_path), "--seconds", "0.2", "--runs", "2", "--json"],
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert ended.returncode in (0, 6), ended.stderr
    found = json.loads(ended.stdout)
    assert found["configured_hz"] == load_rig("rig-demo").line_rate_hz
    assert set(found["limits_hz"]) == {"ring", "codec", "recorder", "processors"}
    assert 1 <= len(found["trials"]) <= 2
    held = [trial["line_rate_hz"] for trial in found["trials"] if trial["held"]]
    assert found["highest_hz"] == max(held, default=None)
    assert (ended.returncode == 0) == bool(held)
    assert not any(tmp_path.iterdir())


def test_bench_refuses_senseless_options(tmp_path: Path) -> None:
    ended = subprocess.run(
        [COMMAND, "bench", "--seconds", "0"], capture_output=True, text=True, check=False, timeout=300
    )
    assert ended.returncode == 2
    assert "0.1 to 600" in ended.stderr
