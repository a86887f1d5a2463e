"""The daemon's salvage with its real process, on recordings that a writer here has left open."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from acquire.capacity.load import Load, recording_spec
from acquire.clock import ClockFit
from acquire.daemon.messages import RecoveryStatus
from acquire.daemon.salvage import Salvage
from acquire.store import RecordingWriter, open_recording
from acquire.store.files import locked
from acquire.stream import Orphan

SPEC = recording_spec(Load(8, "uint16", 1000.0), ClockFit(90_000_000, 0, 0))
WAIT_S = 300.0


@pytest.fixture
def salvage(tmp_path: Path) -> Iterator[Salvage]:
    made = Salvage(tmp_path)
    yield made
    made.close()


def leave_open(path: Path) -> Path:
    with RecordingWriter.create(path, SPEC) as writer:
        writer.commit()
    return path


def states(salvage: Salvage) -> dict[str, str]:
    return {one.path.name: one.state for one in salvage.recoveries}


def look_until(salvage: Salvage, condition: Callable[[], bool], **how: bool) -> list[RecoveryStatus]:
    deadline, ended = time.monotonic() + WAIT_S, []
    while not condition():
        ended += salvage.look(**how)
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return ended


def test_while_a_run_captures_only_what_it_left_is_recovered(salvage: Salvage, tmp_path: Path) -> None:
    """What the search finds waits, unless the run has left it: then it is recovered, for the run's reason."""
    found, ours = (leave_open(tmp_path / f"{name}.zarr") for name in ("found", "ours"))
    salvage.search()
    look_until(salvage, lambda: len(states(salvage)) == 2, capturing=True)
    assert states(salvage) == {"found.zarr": "waiting", "ours.zarr": "waiting"}
    salvage.add([Orphan(ours, "its recorder was killed")])
    (ended,) = salvage.wait(WAIT_S)
    assert (ended.path, ended.state, ended.condition) == (ours, "recovered", "INTERRUPTED")
    assert open_recording(ours).attrs["end_reason"] == "recovered: its recorder was killed"
    assert states(salvage)["found.zarr"] == "waiting"
    look_until(salvage, lambda: states(salvage)["found.zarr"] == "recovered")
    assert open_recording(found).state == "sealed"
    salvage.add([Orphan(ours, "its recorder was killed")])  # the status goes on telling it
    assert salvage.wait(WAIT_S) == []


def test_what_had_not_begun_is_removed(salvage: Salvage, tmp_path: Path) -> None:
    half = tmp_path / "half.zarr"
    (half / "a" / "lines").mkdir(parents=True)
    salvage.add([Orphan(half, "killed"), Orphan(tmp_path / "none.zarr", "killed")])
    salvage.wait(WAIT_S)
    assert states(salvage) == {"half.zarr": "recovered", "none.zarr": "recovered"}
    assert not half.exists()


def test_a_recovery_that_is_killed_is_told(salvage: Salvage, tmp_path: Path) -> None:
    path = leave_open(tmp_path / "r.zarr")
    salvage.add([Orphan(path, "killed")])
    salvage.look()
    assert salvage._worker is not None
    assert salvage._worker.pid is not None
    os.kill(salvage._worker.pid, signal.SIGKILL)
    (ended,) = salvage.wait(WAIT_S)
    assert ended.state == "failed"
    assert "killed by SIGKILL" in ended.text
    assert open_recording(path).state == "recording"


def test_what_somebody_holds_is_looked_at_again_and_left_in_the_end(
    salvage: Salvage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acquire.daemon.salvage.AGAIN_S", 0.01)
    path = leave_open(tmp_path / "r.zarr")
    salvage.search()
    with locked(path, "testing"):
        ended = look_until(salvage, lambda: states(salvage).get("r.zarr") == "left")
    assert "another process is writing it" in ended[-1].text
    assert open_recording(path).state == "recording"


def test_an_arming_daemon_puts_a_recovery_off(salvage: Salvage, tmp_path: Path) -> None:
    path = leave_open(tmp_path / "r.zarr")
    salvage.search()
    look_until(salvage, lambda: salvage._worker is not None)
    salvage.look(capturing=True)
    assert salvage._worker is None
    assert states(salvage) == {"r.zarr": "waiting"}
    look_until(salvage, lambda: states(salvage) == {"r.zarr": "recovered"})
    assert open_recording(path).state == "sealed"
