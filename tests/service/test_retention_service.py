"""An endless recording of the real daemon whose held lines take more than they may: it is said everywhere."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from live_daemon import Daemon
from waiting import until


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    settings = ("recording.retention.max_gb=2e-5", "recording.shard_chunks=1", "recording.commit_s=0.1")
    with contextlib.closing(Daemon(tmp_path, *settings)) as running:
        yield running


def one_line(text: str) -> str:
    """What a terminal broke into lines, wherever the figures made it break."""
    return " ".join(text.split())


def test_held_lines_beyond_the_limit_are_reported(daemon: Daemon) -> None:
    with daemon.client() as client:
        client.arm()
        client.start(daemon.home / "x.zarr")
        now = client.status().recording
        assert now is not None
        assert now.first_line is not None
        newest = now.first_line + now.committed_lines
        held = daemon("hold", "x.zarr", "--first-line", newest, "--lines", 2**40)
        assert held.code in (0, 6), held.err  # 6: retention was quicker with the first of them

        def beyond() -> int:
            now = client.status().recording
            assert now is not None
            return now.beyond_bytes

        until(lambda: beyond() > 10_000, "held lines that take more than they may")
        health = client.health()
        (check,) = [one for one in health.checks if one.name == "held lines"]
        assert check.level == "warning"
        assert re.match(
            r"x\.zarr takes \d+ M?B more than recording\.retention\.max_gb allows: lines are held", check.text
        )
        assert "lines are held" in one_line(daemon("status").out)
        with httpx.Client(transport=httpx.HTTPTransport(uds=str(daemon.socket))) as raw:
            text = raw.get("http://acquire/metrics").text
        (value,) = re.findall(r"^acquire_held_beyond_limit_bytes (\S+)$", text, re.MULTILINE)
        assert float(value) > 10_000
        client.stop()
    until(lambda: "lines are held" in daemon.log.read_text())
    assert daemon.log.read_text().count("lines are held") == 1
    assert "lines are held" in one_line(daemon("info", "x.zarr").out)
