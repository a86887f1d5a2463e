"""The recordings' directory goes away and comes back while the daemon works: it says so, and goes on."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import frozen_disk
import httpx
import psutil
import pytest
from live_daemon import LINE_RATE_HZ, Daemon
from waiting import until

from acquire.client import Client
from acquire.daemon.journal import only_user
from acquire.daemon.states import State
from acquire.errors import StateError, StoreError
from acquire.store import open_recording

AWAY = "no recording can begin in "
BLOCK_LINES = 64


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """The directory of the recordings."""
    path = tmp_path / "recordings"
    path.mkdir()
    return path


@pytest.fixture
def daemon(tmp_path: Path, place: Path) -> Iterator[Daemon]:
    daemon = Daemon(tmp_path, f"recording.directory='{place}'")
    yield daemon
    daemon.close()


def asked(daemon: Daemon, url: str) -> str:
    with httpx.Client(transport=httpx.HTTPTransport(uds=str(daemon.socket))) as client:
        return client.get(f"http://acquire{url}").text


def check_away(daemon: Daemon, client: Client, why: str) -> None:
    """Status, health, metrics and log say it, and a start is refused with the same words."""
    with pytest.raises(StoreError, match=why) as refused:
        client.start(pre_s=1.0, lines=256)
    assert refused.value.hint
    until(lambda: client.status().disk_trouble is not None, "the status")
    assert re.search(why, str(client.status().disk_trouble))
    assert "WARNING: no recording can begin" in daemon("status").out.replace("\n", " ")
    until(lambda: "directory_usable 0" in asked(daemon, "/metrics"), "the metrics")
    health = client.health()
    assert (health.level, bool(re.search(why, health.sentence))) == ("degraded", True)
    assert re.search(why, asked(daemon, "/healthz"))
    assert f"ERROR {AWAY}" in daemon.log.read_text()


def check_back(daemon: Daemon, client: Client, path: Path, reach_s: float) -> None:
    """A recording begins at once, with lines from before."""
    held = lambda: min(arm.ring.history for arm in client.status().arms.values()) * BLOCK_LINES  # noqa: E731
    until(lambda: held() > (reach_s + 0.1) * LINE_RATE_HZ, "the rings")
    client.start(path, pre_s=reach_s, lines=round(reach_s * LINE_RATE_HZ) + 256)
    status = client.wait({State.ARMED}, 120)
    assert status.last is not None
    assert (status.last.path, status.last.condition) == (path, "GOOD")
    assert open_recording(path).lines == round(reach_s * LINE_RATE_HZ) + 256
    until(lambda: client.status().disk is not None, "the disk")
    assert client.status().disk_trouble is None
    assert "directory_usable 1" in asked(daemon, "/metrics")
    assert "INFO recordings can begin in the configured directory again" in daemon.log.read_text()


def test_a_directory_that_was_moved_away_and_back(daemon: Daemon, place: Path) -> None:
    with daemon.client() as client:
        client.arm()
        place.rename(place.with_name("elsewhere"))
        check_away(daemon, client, "it is not there")
        place.write_text("a file")
        check_away(daemon, client, "it is not a directory")
        place.unlink()
        place.with_name("elsewhere").rename(place)
        check_back(daemon, client, place / "x.zarr", 2.0)


def test_a_directory_that_was_removed_and_made_again(daemon: Daemon, place: Path) -> None:
    with daemon.client() as client:
        until(lambda: client.status().disk is not None, "the disk")
        shutil.rmtree(place)
        until(lambda: client.status().disk_trouble is not None, "the status")
        assert client.status().state is State.IDLE
        assert client.health().level == "degraded"
        place.mkdir()
        client.arm()
        check_back(daemon, client, place / "x.zarr", 0.0)
        check_replaced(daemon, client, place)


def test_a_directory_that_may_not_be_written(daemon: Daemon, place: Path) -> None:
    with daemon.client() as client:
        client.arm()
        place.chmod(0o555)
        try:
            check_away(daemon, client, "may not write")
        finally:
            place.chmod(0o755)
        check_back(daemon, client, place / "x.zarr", 1.0)


def check_replaced(daemon: Daemon, client: Client, place: Path) -> None:
    """Another directory in its place is noticed, and is this daemon's once no other one has its lock."""
    other = place.with_name("other")
    other.mkdir()
    with only_user(other, "small"):
        place.rename(place.with_name("first"))
        other.rename(place)
        check_away(daemon, client, rf"another daemon .process {os.getpid()}. of a rig named small records")
    words = f"{place} is another directory than before"
    until(lambda: words in daemon.log.read_text(), "the log")
    assert client.start(lines=256).disk_trouble is None
    assert client.wait({State.ARMED}, 120).last is not None
    with pytest.raises(StateError, match=f"process {daemon.process.pid}"), only_user(place, "small"):
        pass


@pytest.mark.needs_mount
def test_the_host_s_own_disk_is_not_filled_while_another_is_not_mounted(tmp_path: Path) -> None:
    with frozen_disk.mounted(tmp_path) as disk:
        place = disk.path / "recordings"
        place.mkdir()
        daemon = Daemon(tmp_path, f"recording.directory='{place}'", "recording.reserve_gb=0.01")
        try:
            with daemon.client() as client:
                client.arm()
                # The journal's lock is on the disk: lazily, as an unplugged one goes.
                subprocess.run(["umount", "--lazy", disk.path], check=True)
                place.mkdir()  # below the mount point, as somebody may have who wanted to record
                check_away(daemon, client, "is not mounted on")
                assert not [*place.glob("*.zarr")]
                subprocess.run(["mount", "-o", "loop", tmp_path / "disk.img", disk.path], check=True)
                check_back(daemon, client, place / "x.zarr", 2.0)
                check_segment_refused(daemon, client, place / "y.zarr", disk.path)
                subprocess.run(["mount", "-o", "loop", tmp_path / "disk.img", disk.path], check=True)
                client.disarm()
                until(lambda: [one.state for one in client.status().recoveries] == ["recovered"], "recovery")
                assert open_recording(place / "y.zarr").lines > 300
        finally:
            daemon.close()


def check_segment_refused(daemon: Daemon, client: Client, path: Path, mount: Path) -> None:
    """A recorder is killed while the disk goes: its successor writes nothing to the host's own disk."""
    client.start(path)
    until(lambda: (now := client.status().recording) is not None and now.committed_lines > 300, "lines")
    recorder = psutil.Process(client.status().processes["recorder"])
    recorder.suspend()
    subprocess.run(["umount", "--lazy", mount], check=True)
    recorder.kill()
    until(lambda: client.status().state is State.FAULTED, "the fault")
    fault = str(client.status().fault)
    assert f"no recording can begin in {path.parent}: its disk is not mounted on {mount} any more" in fault
    assert not [*path.parent.glob("*.zarr")]


def test_what_was_left_open_is_recovered_once_its_disk_is_there(tmp_path: Path, place: Path) -> None:
    daemon = Daemon(tmp_path, f"recording.directory='{place}'")
    path = place / "x.zarr"
    try:
        with daemon.client() as client:
            client.arm()
            client.start(path)
            until(
                lambda: (now := client.status().recording) is not None and now.committed_lines > 300, "lines"
            )
        daemon.process.kill()
        daemon.process.wait()
    finally:
        daemon.close()
    place.rename(place.with_name("elsewhere"))
    place.mkdir()  # as a mount point is without its disk
    daemon = Daemon(tmp_path, f"recording.directory='{place}'")
    try:
        with daemon.client() as client:
            until(lambda: client.status().disk is not None, "the disk")
            shutil.rmtree(place)
            until(lambda: client.status().disk_trouble is not None, "the status")
            place.with_name("elsewhere").rename(place)
            until(lambda: [one.state for one in client.status().recoveries] == ["recovered"], "a recovery")
        assert open_recording(path).lines > 300
    finally:
        daemon.close()
