"""The real daemon copies what it records to a real S3 server, which disappears, is slow, or refuses."""

from __future__ import annotations

import signal
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from live_daemon import Daemon, until_gone
from s3_server import BUCKET, S3Server
from waiting import until

from acquire.daemon.messages import UploadStatus
from acquire.lines import ARMS
from acquire.store import open_recording, verify

WAIT_S = 300.0
SHARD_LINES = 32 * 256
SHARDS = "recording.shard_chunks=32"  # 0.8 s


@pytest.fixture
def server() -> Iterator[S3Server]:
    made = S3Server()
    made.start()
    made.create_bucket()
    yield made
    made.stop()


class Lab:
    """Daemons in one directory, one after the other, and the target of their copies."""

    def __init__(self, home: Path, server: S3Server) -> None:
        self.home = home
        self.server = server
        self.prefix = str(uuid.uuid4())
        self._started: list[Daemon] = []

    def start(self, *settings: str) -> Daemon:
        upload_to = f'recording.upload_to="s3://{BUCKET}/{self.prefix}"'
        self._started.append(Daemon(self.home, upload_to, SHARDS, *settings, **self.server.environment))
        return self._started[-1]

    def download(self, to: Path) -> Path:
        return self.server.download(self.prefix, to)

    def close(self) -> None:
        for daemon in self._started:
            daemon.close()


@pytest.fixture
def lab(tmp_path: Path, server: S3Server) -> Iterator[Lab]:
    home = tmp_path / "home"
    home.mkdir()
    made = Lab(home, server)
    yield made
    server.open.set()
    made.close()


def record(daemon: Daemon, name: str = "x.zarr") -> Path:
    assert daemon("arm").code == 0
    return start(daemon, name)


def start(daemon: Daemon, name: str = "x.zarr") -> Path:
    with daemon.client() as client:
        client.start(daemon.home / name)
    return daemon.home / name


def committed(daemon: Daemon) -> int:
    with daemon.client() as client:
        now = client.status().recording
        return 0 if now is None else now.committed_lines


def upload(daemon: Daemon, name: str = "x.zarr") -> UploadStatus:
    with daemon.client() as client:
        found = [one for one in client.status().uploads if one.path.name == name]
    return found[0] if found else UploadStatus(path=Path(name), url="", state="gone")


def files(path: Path) -> dict[str, bytes]:
    """All that have lines, or say something of them, but for the root's: the copy of that does not tell of
    holds. A recorder that is killed may leave pixels behind the last line, whose tags it did not write.
    """
    recording = open_recording(path)
    shards = -(-recording.lines // recording.arms["a"].reader("lines").shape.shard_rows)
    found = {file.relative_to(path): file for file in path.rglob("*") if file.is_file()}
    return {
        str(name): file.read_bytes()
        for name, file in found.items()
        if name != Path("zarr.json")
        and not name.name.startswith(".")
        and not (name.parts[0] in ARMS and name.parts[2:3] == ("c",) and int(name.parts[3]) >= shards)
    }


def check_copy(there: Path, here: Path) -> None:
    """Check that the copy is identical to the byte."""
    assert files(there) == files(here)
    assert open_recording(there).info() | {"path": "", "bytes": 0} == open_recording(here).info() | {
        "path": "",
        "bytes": 0,
    }
    assert verify(there).intact


def test_a_server_that_disappears_and_returns_delays_nobody(lab: Lab, tmp_path: Path) -> None:
    daemon = lab.start()
    path = record(daemon)
    until(lambda: upload(daemon).lines >= SHARD_LINES)  # while it grows
    lab.server.stop()
    until(lambda: bool(upload(daemon).error))
    assert "network" in upload(daemon).hint
    until(lambda: (upload(daemon).waiting_lines or 0) > SHARD_LINES)
    stopped = daemon("stop")
    assert stopped.code == 0
    assert "x.zarr waiting" in stopped.out
    assert open_recording(path).state == "sealed"
    lab.server.start()
    until(lambda: upload(daemon).state == "copied")
    assert upload(daemon).error == ""
    lines = open_recording(path).lines
    assert f"x.zarr copied, {lines} lines copied" in daemon("status").out
    check_copy(lab.download(tmp_path / "far") / "x.zarr", path)
    assert daemon.end() == 0


def test_everything_is_uploaded_although_daemon_and_recorder_are_killed(lab: Lab, tmp_path: Path) -> None:
    daemon = lab.start()
    first = record(daemon)
    until(lambda: upload(daemon).lines >= SHARD_LINES)
    with daemon.client() as client:
        psutil.Process(client.status().processes["recorder"]).kill()
    until(lambda: upload(daemon, "x-2.zarr").lines >= SHARD_LINES)
    lab.server.put_begun.clear()
    lab.server.open.clear()
    assert lab.server.put_begun.wait(WAIT_S)  # something is under way
    family = [psutil.Process(daemon.process.pid), *daemon.children()]
    daemon.end(signal.SIGKILL)
    lab.server.open.set()
    until_gone(family[1:])
    again = lab.start()
    second = lab.home / "x-2.zarr"
    until(lambda: {upload(again).state, upload(again, "x-2.zarr").state} == {"copied"})
    until(lambda: open_recording(first).attrs["segments"] == ["x-2.zarr"])
    until(lambda: upload(again).state == "copied")
    far = lab.download(tmp_path / "far")
    for path in (first, second):
        assert open_recording(path).attrs["run_condition"] == "INTERRUPTED"
        check_copy(far / path.name, path)
    assert [segment.lines for segment in open_recording(far / "x.zarr").segments] == [
        open_recording(second).lines
    ]


def test_retention_waits_for_a_slow_store(lab: Lab, tmp_path: Path) -> None:
    daemon = lab.start("recording.retention.max_age_s=0.2", "recording.commit_s=0.2")
    assert daemon("arm").code == 0  # which asks the store, and would wait for it
    lab.server.open.clear()  # before anything is copied
    path = start(daemon)
    until(lambda: committed(daemon) > 3 * SHARD_LINES)
    assert open_recording(path).dropped == ()
    lab.server.open.set()
    until(lambda: open_recording(path).dropped != ())
    first = open_recording(path).first_line
    assert daemon("stop").code == 0
    until(lambda: upload(daemon).state == "copied")
    far = open_recording(lab.download(tmp_path / "far") / "x.zarr")
    assert (far.first_line, far.lines, far.dropped) == (first, open_recording(path).lines, ())
    assert verify(far.source.path).intact  # type: ignore[attr-defined]


def test_a_store_that_hangs_does_not_keep_the_daemon_from_ending(lab: Lab, tmp_path: Path) -> None:
    daemon = lab.start()
    path = record(daemon)
    until(lambda: upload(daemon).state == "copying")
    lab.server.open.clear()
    until(lambda: committed(daemon) > 2 * SHARD_LINES)
    begun = time.monotonic()
    assert daemon.end() == 0
    assert time.monotonic() - begun < 200
    assert open_recording(path).attrs["end_reason"] == "signal"
    lab.server.open.set()
    again = lab.start()
    until(lambda: upload(again).state == "copied")
    check_copy(lab.download(tmp_path / "far") / "x.zarr", path)


def test_a_refusing_store_is_an_error_and_an_unreachable_one_a_warning(lab: Lab) -> None:
    daemon = lab.start()
    place = f"s3://{BUCKET}/{lab.prefix}"
    lab.server.denies = True
    refused = daemon("arm")
    assert refused.code == 2
    assert f"recordings cannot be uploaded: {place} cannot be written" in refused.err
    assert "403 Forbidden" in refused.err
    assert "arm --force" in refused.err
    forced = daemon("arm", "--force")
    assert forced.code == 0
    assert f"WARNING: {place} cannot be written" in " ".join(forced.out.split())  # however wide the terminal
    assert daemon("disarm").code == 0
    lab.server.denies = False
    assert daemon("arm", "--json").json["upload_warning"] is None
    assert daemon("disarm").code == 0
    lab.server.stop()
    armed = daemon("arm", "--json").json
    assert armed["state"] == "armed"
    assert armed["upload_warning"].startswith(f"{place} cannot be written: ")
    assert daemon.end() == 0
