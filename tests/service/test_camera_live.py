"""``acquire camera live`` next to a recording daemon: it sees the lines and takes none away."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from live_daemon import Daemon

from acquire.client import SEALED
from acquire.store import open_recording


def test_an_observer_of_the_daemon_s_rings(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    try:
        idle = daemon("camera", "live")
        assert (idle.code, "the daemon is idle" in idle.err) == (4, True)
        with daemon.client() as client:
            client.arm()
            client.start(tmp_path / "run.zarr")
            words = ("camera", "live", "--json", "--seconds", 1)
            turns = [json.loads(line) for line in daemon(*words).out.splitlines()]
            only_b = json.loads(
                daemon("camera", "live", "B", "--json", "--seconds", "0.1").out.splitlines()[0]
            )
            assert "acquire arm --code dark" in daemon("camera", "live", "--code", "dark").err
            client.stop()
            client.wait(SEALED, timeout_s=120)
            assert client.status().last.condition == "GOOD"
        assert sum(turn["b"]["lines"] for turn in turns) > 1000
        assert "a" not in only_b
        lines = open_recording(tmp_path / "run.zarr").camera("a").lines[:]
        # on a busy host no line may come within a turn
        *_, reading = [turn["a"] for turn in turns if turn["a"]["level"] is not None]
        assert reading["level"] == pytest.approx(lines.mean() / 4095, rel=0.1)
        assert reading["saturated"] == pytest.approx((lines == 4095).mean(), abs=0.01)
    finally:
        daemon.close()
