"""Two rigs, each with a daemon, that record to one disk, nearly full: neither loses what is the other's."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_daemon import Daemon
from waiting import until

from acquire.daemon.messages import Status
from acquire.daemon.states import State
from acquire.store import open_recording, verify

RESERVE = 12_000_000
"""More than a busy host writes between two looks at the disk."""
ENDLESS = ("recording.retention.segment_lines=500", "recording.shard_chunks=4")

pytestmark = pytest.mark.needs_mount


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 48 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=48m", "none", place], check=True)
    yield place
    subprocess.run(["umount", "--lazy", place], check=True)


def daemon_of(name: str, home: Path, directory: Path, *settings: str) -> Daemon:
    home.mkdir(exist_ok=True)
    directory.mkdir(exist_ok=True)
    reserve = f"recording.reserve_gb={RESERVE / 1e9}"
    return Daemon(home, f"name='{name}'", f"recording.directory='{directory}'", reserve, *settings)


def seconds_to_full(status: Status) -> float:
    assert status.disk is not None
    return status.disk.seconds_to_full


@pytest.mark.parametrize("shared", [True, False])
def test_an_endless_recording_and_another_share_a_disk(tmp_path: Path, disk: Path, shared: bool) -> None:
    """One drops its own oldest lines, the other ends; a daemon that starts then touches neither."""
    places = [disk, disk] if shared else [disk / "one", disk / "two"]
    one = daemon_of("one", tmp_path / "1", places[0], *ENDLESS)
    two = daemon_of("two", tmp_path / "2", places[1])
    endless, ending = places[0] / "endless.zarr", places[1] / "ending.zarr"
    try:
        with one.client() as first, two.client() as second:
            for client, path in ((first, endless), (second, ending)):
                client.arm()
                client.start(path)
            # Each counts what both write.
            until(
                lambda: all(seconds_to_full(client.status()) < 60 for client in (first, second)), "the time"
            )
            second.wait({State.ARMED, State.FAULTED}, 300)
            ended = second.status()
            assert (ended.state, ended.fault) == (State.ARMED, None)
            assert ended.last is not None
            assert (ended.last.condition, "disk nearly full" in (ended.last.end_reason or "")) == (
                "INTERRUPTED",
                True,
            )
            until(lambda: len(open_recording(endless).dropped) > 0, "dropped lines")
            os.killpg(two.process.pid, signal.SIGKILL)
            two.process.wait()
            two = daemon_of("two", tmp_path / "2", places[1])
            lines = open_recording(endless).lines
            until(lambda: open_recording(endless).lines > lines + 20_000, "more lines")
            assert first.status().state is State.RECORDING
            first.stop()
            assert first.wait({State.ARMED}, 60).fault is None
    finally:
        one.close()
        two.close()
    whole, rest = open_recording(ending), open_recording(endless)
    assert (whole.state, whole.lines, whole.dropped) == ("sealed", ended.last.lines, ())
    assert (rest.state, rest.attrs["run_condition"]) == ("sealed", "GOOD")
    for recording in (whole, rest):
        assert verify(recording.path).intact
        assert not recording.gaps
