"""The service over a capture path that the test scripts: what each command and each failure leaves behind."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_run import FakeRun, rig_config
from waiting import until

from acquire.config import load_rig
from acquire.daemon.messages import ArmRequest, StartRequest
from acquire.daemon.service import Service
from acquire.daemon.states import State
from acquire.errors import CameraError, DeviceError, StateError, UsageError
from acquire.store import RunCondition
from acquire.stream import Window
from acquire.stream.messages import Note


class Bed:
    """A service and the run that it will open."""

    def __init__(self, directory: Path, run: FakeRun, **settings: object) -> None:
        self.run = run
        self.opened = 0
        self.service = Service(rig_config(directory, **settings), self._open)

    def _open(self, request: ArmRequest) -> FakeRun:
        self.opened += 1
        return self.run

    @property
    def state(self) -> State:
        return self.service.status().state

    def record(self, **request: object) -> None:
        self.service.arm()
        self.service.start(StartRequest.model_validate(request))


@pytest.fixture
def bed(tmp_path: Path) -> Bed:
    return Bed(tmp_path, FakeRun())


def test_life(bed: Bed, tmp_path: Path) -> None:
    """Two recordings of one run: staying armed is the default."""
    path = tmp_path / "x.zarr"
    bed.record(path=path, lines=500)
    status = bed.service.status()
    assert (status.state, status.run_id) == (State.RECORDING, "fake-run")
    assert status.recording is not None
    assert (status.recording.path, status.recording.budget_lines) == (path, 500)
    bed.service.stop()
    assert bed.run.names == ["arm", "start", "stop"]
    status = bed.service.status()
    assert (status.state, status.run_id, status.recording) == (State.ARMED, "fake-run", None)
    assert status.last is not None
    assert (status.last.path, status.last.lines, status.last.condition) == (path, 500, "GOOD")
    bed.run.see(done=False, condition=None)
    bed.service.start(StartRequest(path=tmp_path / "y.zarr"))
    bed.service.stop()
    bed.service.disarm()
    assert bed.run.names == ["arm", "start", "stop", "start", "stop", "close"]
    assert bed.state is State.IDLE
    assert bed.service.status().last is not None
    assert bed.service.status().last.path == tmp_path / "y.zarr"


def test_a_rig_can_ask_for_idle_after_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "x.zarr"
    bed = Bed(tmp_path, FakeRun(), **{"recording.after": "idle"})
    bed.record(path=path, lines=500)
    bed.service.stop()
    assert bed.run.names == ["arm", "start", "stop", "close"]
    status = bed.service.status()
    assert (status.state, status.run_id, status.recording) == (State.IDLE, None, None)
    assert status.last is not None
    assert (status.last.path, status.last.lines, status.last.condition) == (path, 500, "GOOD")


def test_refused_command_touches_nothing(bed: Bed) -> None:
    with pytest.raises(StateError, match="cannot start while idle"):
        bed.service.start(StartRequest())
    with pytest.raises(StateError, match="cannot stop while idle"):
        bed.service.stop()
    assert (bed.opened, bed.run.calls) == (0, [])
    bed.service.arm()
    with pytest.raises(StateError, match="cannot arm while armed"):
        bed.service.arm()
    assert bed.opened == 1


def test_failing_arm_stays_idle(tmp_path: Path) -> None:
    bed = Bed(tmp_path, FakeRun(arm=CameraError("camera a is not there")))
    with pytest.raises(CameraError):
        bed.service.arm()
    status = bed.service.status()
    assert (status.state, status.busy, status.run_id) == (State.IDLE, None, None)


def test_refused_start_stays_armed(tmp_path: Path) -> None:
    bed = Bed(tmp_path, FakeRun(start=UsageError("x.zarr exists")))
    with pytest.raises(UsageError):
        bed.record()
    assert (bed.state, bed.service.status().recording) == (State.ARMED, None)
    bed.run.refuse.clear()
    bed.service.start(StartRequest())
    assert bed.state is State.RECORDING


def test_budget_drains_and_ends_by_itself(bed: Bed) -> None:
    bed.record(lines=500)
    bed.run.see(draining=True)
    bed.service.supervise()
    assert bed.state is State.DRAINING
    assert "close" not in bed.run.names
    bed.run.seal(reason="line budget reached")
    bed.service.supervise()
    assert bed.state is State.ARMED
    assert bed.service.status().last is not None
    assert "close" not in bed.run.names


def test_recording_sealed_between_two_looks(bed: Bed) -> None:
    bed.record(lines=500)
    bed.run.seal()
    bed.service.supervise()
    assert bed.state is State.ARMED


def test_budget_in_seconds_rounds_up(bed: Bed) -> None:
    bed.record(duration_s=0.0100001)
    assert bed.run.calls[-1][2] == 334  # 33,333.3 lines per second


def test_a_take_is_not_told_as_the_one_before_it(bed: Bed, tmp_path: Path) -> None:
    """Until the capture was seen again, it had the last one's path and lines, and was news as its segment."""
    first, second = tmp_path / "first.zarr", tmp_path / "second.zarr"
    bed.service.arm()
    bed.service.start(StartRequest(path=first))
    bed.run.see(path=str(first), recording=True, recorded_lines=100, committed_lines=100, first_line=7)
    bed.service.supervise()
    bed.run.see(recording=False, done=True)
    bed.service.stop()
    bed.service.supervise()
    bed.run.see(done=False)
    bed.service.start(StartRequest(path=second))
    now = bed.service.status().recording
    assert now is not None
    assert (now.path, now.recorded_lines, now.first_line) == (second, 0, None)
    bed.run.see(path=str(second), recording=True, done=False, recorded_lines=5, committed_lines=5)
    bed.service.supervise()
    assert not [one for one in bed.service.news.after(None) if one.kind == "segment"]
    bed.service.disarm() if bed.state is State.ARMED else bed.service.shutdown()


def test_default_paths_are_free_and_in_the_configured_directory(bed: Bed, tmp_path: Path) -> None:
    seen = set()
    bed.service.arm()
    for _ in range(3):
        bed.run.see(done=False)
        bed.service.start(StartRequest())
        path = bed.run.calls[-1][1]
        assert path.parent == tmp_path
        assert path.name.startswith("demo-2")
        assert path.suffix == ".zarr"
        path.mkdir()
        seen.add(path)
        bed.service.stop()
    assert len(seen) == 3


@pytest.mark.parametrize("recording", [False, True])
def test_fault_releases_the_devices_and_waits_to_be_read(bed: Bed, recording: bool) -> None:
    bed.service.arm()
    if recording:
        bed.service.start(StartRequest())
    bed.run.see(fault="grabber a: killed by SIGKILL")
    bed.service.supervise()
    status = bed.service.status()
    assert (status.state, status.fault) == (State.FAULTED, "grabber a: killed by SIGKILL")
    assert bed.run.names[-1] == "close"
    if recording:
        assert status.last is not None
        assert status.last.condition == RunCondition.INTERRUPTED
    bed.service.disarm()
    assert (bed.state, bed.service.status().fault) == (State.IDLE, None)
    bed.service.arm()
    assert bed.state is State.ARMED


@pytest.mark.parametrize("error", [CameraError("lost"), OSError("lost")])
def test_a_look_that_fails_is_a_fault(tmp_path: Path, error: Exception) -> None:
    bed = Bed(tmp_path, FakeRun(poll=error))
    with pytest.raises(DeviceError, match="lost"):
        bed.service.arm()
    assert (bed.state, bed.service.status().fault) == (State.FAULTED, "lost")


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (CameraError("does not let go"), "does not let go"),
        (OSError("no memory"), "the devices could not be released in order: no memory"),
    ],
)
def test_fault_tells_of_a_failing_end_too(tmp_path: Path, error: Exception, told: str) -> None:
    bed = Bed(tmp_path, FakeRun(close=error))
    bed.service.arm()
    bed.run.see(fault="first")
    bed.service.supervise()
    assert str(bed.service.status().fault).startswith(f"first; then, while ending: {told}")


def test_a_fault_names_what_ended_the_recording_before_what_went_wrong_after_it(tmp_path: Path) -> None:
    run = FakeRun(close=DeviceError("grabber b: the process did not end when told to"))
    bed = Bed(tmp_path, run, **{"recording.after": "idle"})
    bed.record()
    bed.run.seal(reason="arm b stalled: no line for 3 s", condition=RunCondition.INCOMPLETE)
    bed.service.supervise()
    assert bed.service.status().fault == (
        "arm b stalled: no line for 3 s; then, while ending: grabber b: the process did not end when told to"
    )


def test_a_recording_that_the_disk_ended_is_a_fault(bed: Bed) -> None:
    bed.record()
    bed.run.seal(lines=200, reason="write error: no space left", condition=RunCondition.ABORTED)
    bed.run.see(recorded_lines=300)
    bed.service.supervise()
    status = bed.service.status()
    assert (status.state, status.possible) == (State.FAULTED, ["disarm"])
    assert status.fault == "the recording was aborted: write error: no space left"
    assert status.last is not None
    assert (status.last.lines, status.last.condition) == (200, "ABORTED")  # as many as the file holds
    bed.service.disarm()
    assert (bed.state, bed.service.status().fault) == (State.IDLE, None)


@pytest.mark.parametrize(
    "command",
    [
        lambda service: service.start(StartRequest()),
        lambda service: service.arm(),
        lambda service: service.mark("here"),
        lambda service: service.stop(),
        lambda service: service.measure(),
    ],
    ids=["start", "arm", "mark", "stop", "measure"],
)
def test_what_a_fault_forbids_is_refused_with_the_fault(bed: Bed, command: Callable[[Any], None]) -> None:
    """It said only "cannot start while faulted"."""
    bed.record()
    bed.run.see(fault="camera a is gone")
    bed.service.supervise()
    with pytest.raises(StateError, match="while faulted: camera a is gone") as refused:
        command(bed.service)
    assert (refused.value.possible, refused.value.hint.startswith("acquire disarm ")) == ("disarm", True)


def test_failing_end_after_sealing_is_a_fault(tmp_path: Path) -> None:
    bed = Bed(tmp_path, FakeRun(close=CameraError("does not let go")), **{"recording.after": "idle"})
    bed.record()
    with pytest.raises(DeviceError, match="does not let go"):
        bed.service.stop()
    assert (bed.state, bed.service.status().fault) == (State.FAULTED, "does not let go")
    assert bed.service.status().last is not None


def test_draining_has_an_end_once_nothing_moves(tmp_path: Path) -> None:
    bed = Bed(tmp_path, FakeRun(), **{"recording.seal_timeout_s": 0.2})
    bed.run.seals_at_stop = False
    bed.record()
    bed.service.stop()
    for lines in range(10):  # a slow disk is no fault
        bed.run.see(committed_lines=lines)
        bed.service.supervise()
        assert bed.state is State.DRAINING
    until(lambda: bed.service.supervise() or bed.state is not State.DRAINING, "a fault")
    status = bed.service.status()
    assert status.state is State.FAULTED
    assert "nothing more of it reached the disk for 0.2 s" in str(status.fault)
    assert bed.run.names[-1] == "close"


def test_marks_are_taken_while_a_recording_drains(bed: Bed) -> None:
    bed.run.seals_at_stop = False
    bed.record()
    bed.service.stop()
    bed.service.mark("meanwhile")
    assert (bed.state, bed.run.calls[-1]) == (State.DRAINING, ("note", "mark", "meanwhile"))


def test_events_that_a_recording_does_not_list_are_counted_in_the_log(
    bed: Bed, caplog: pytest.LogCaptureFixture
) -> None:
    bed.record()
    bed.run.see(ledger={"events_not_listed": 12})
    bed.service.stop()
    bed.service.supervise()
    assert "does not list its last 12 events" in caplog.text


def test_hurry_ends_the_wait_and_the_run(bed: Bed) -> None:
    bed.run.seals_at_stop = False
    bed.record()
    bed.service.stop()
    assert bed.state is State.DRAINING
    bed.service.hurry()
    bed.service.supervise()
    assert bed.state is State.IDLE
    assert bed.service.status().last is not None
    assert bed.service.status().last.condition == RunCondition.INTERRUPTED


@pytest.mark.parametrize(
    ("prepare", "calls"),
    [
        ([], []),
        (["arm"], ["arm", "close"]),
        (["arm", "start"], ["arm", "start", "stop", "close"]),
    ],
)
def test_shutdown_ends_what_is_under_way(bed: Bed, prepare: list[str], calls: list[str]) -> None:
    if prepare:
        bed.service.arm()
    if "start" in prepare:
        bed.service.start(StartRequest())
    bed.service.shutdown()
    assert bed.run.names == calls
    assert ("stop", "signal") in bed.run.calls or "stop" not in calls
    assert bed.state is State.IDLE


def test_status_has_the_numbers_of_each_arm(bed: Bed) -> None:
    bed.service.arm()
    bed.service.supervise()
    arm = bed.service.status().arms["a"]
    assert (arm.delivered, arm.preroll, arm.discarded) == (100, 65, 35)
    assert (arm.lost, arm.rate_hz) == ({"camera": 0}, 0.0)
    assert (arm.ring.slots, arm.ring.fill, arm.ring.peak, arm.ring.drops) == (8, 1, 2, 0)


@pytest.mark.parametrize(
    "request_",
    [
        {"lines": 0},
        {"duration_s": -1},
        {"duration_s": math.inf},
        {"lines": 5, "duration_s": 1},
        {"path": "relative.zarr"},
        {"path": "/tmp/nul\0.zarr"},
        {"path": "/tmp/\udcff.zarr"},
    ],
)
def test_impossible_requests(request_: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="validation error"):
        StartRequest.model_validate(request_)


def test_shutdown_closes_the_run_whatever_fails(tmp_path: Path) -> None:
    bed = Bed(tmp_path, FakeRun(stop=CameraError("does not stop")))
    bed.record()
    bed.service.shutdown()
    assert bed.run.names[-1] == "close"
    assert bed.service.status().last is not None


def eventful(directory: Path, **events: object) -> Bed:
    """A service whose rig records by itself, at a tenth of a second's notice."""
    bed = Bed(directory, FakeRun())
    settings = {"recording.directory": str(directory), "stream.ring_seconds": 1.0}
    told = {key if "." in key else f"events.{key}": value for key, value in events.items()}
    given = {"events.pre_s": 0.1, "events.post_s": 0.2, **told}
    bed.service = Service(load_rig("rig-demo", {**settings, **given}), bed._open)
    bed.service.arm()
    return bed


def test_an_event_starts_a_recording_with_what_was_before(tmp_path: Path) -> None:
    bed = eventful(tmp_path, sources=["input"])
    bed.run.happened = [Note(1000, "threshold", ""), Note(9000, "input", "tick 5")]
    bed.service.supervise()
    status = bed.service.status()
    assert (status.state, status.recording and status.recording.budget_lines) == (State.RECORDING, 10_001)
    assert bed.run.window == Window(9000, 3334, 6667, exact=False)
    bed.run.happened = [Note(12_000, "input", "")]
    bed.service.supervise()
    assert bed.run.calls[-1] == ("extend", 12_000 + 6667)
    bed.run.seal()
    bed.service.supervise()
    assert (bed.state, "close" in bed.run.names) == (State.ARMED, False)
    bed.run.see(done=False)
    bed.run.happened = [Note(30_000, "input", "")]
    bed.service.supervise()
    assert bed.state is State.ARMED  # without events.rearm, the first event records
    bed.service.start(StartRequest())
    bed.service.mark("the operator records all the same")
    assert bed.state is State.RECORDING


def test_an_event_may_lead_to_idle(tmp_path: Path) -> None:
    bed = eventful(tmp_path, sources=["mark"], **{"recording.after": "idle"})
    bed.service.mark("now")
    bed.run.seal()
    bed.service.supervise()
    assert (bed.state, bed.run.names[-1]) == (State.IDLE, "close")


def test_a_rig_that_rearms_waits_for_the_next_event(tmp_path: Path) -> None:
    bed = eventful(tmp_path, sources=["mark"], rearm=True)
    for number in (1, 2):
        bed.service.mark("now")
        assert bed.state is State.RECORDING
        bed.run.seal(lines=number)
        bed.service.supervise()
        last = bed.service.status().last
        assert (bed.state, last and last.lines) == (State.ARMED, number)
        bed.run.see(done=False, condition=None, end_reason=None)
    bed.service.mark("once more")
    bed.service.stop()  # a command: also then it stays armed for the next event
    assert (bed.state, "close" in bed.run.names) == (State.ARMED, False)
    bed.service.disarm()
    assert bed.state is State.IDLE


def test_an_event_while_a_recording_is_sealed_is_not_forgotten(tmp_path: Path) -> None:
    bed = eventful(tmp_path, sources=["input"], rearm=True)
    bed.run.happened = [Note(9000, "input", "")]
    bed.service.supervise()
    bed.run.see(draining=True)
    bed.service.supervise()
    assert bed.state is State.DRAINING
    bed.run.happened = [Note(20_000, "input", ""), Note(20_100, "input", "")]
    bed.service.supervise()
    bed.run.seal()
    bed.service.supervise()
    assert (bed.state, bed.run.window.at) == (State.RECORDING, 20_000)


def test_a_mark_is_only_noted_where_nobody_asked_for_more(bed: Bed) -> None:
    with pytest.raises(StateError, match="cannot mark while idle"):
        bed.service.mark("too early")
    bed.service.arm()
    bed.service.mark("hello")
    assert (bed.state, bed.run.calls[-1]) == (State.ARMED, ("note", "mark", "hello"))
    bed.service.start(StartRequest(pre_s=0.01, post_s=0.01))
    assert bed.run.window == Window(None, 334, 334, kind="mark", text="acquire start")
    bed.service.mark("hello")
    assert bed.run.calls[-1] == ("note", "mark", "hello")  # nothing is prolonged


def test_a_defect_beside_the_capture_does_not_keep_it_from_being_watched(
    bed: Bed, monkeypatch: pytest.MonkeyPatch
) -> None:
    bed.record()

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(bed.service._salvage, "poll", broken)
    monkeypatch.setattr(bed.service._uploads, "poll", broken)
    monkeypatch.setattr(bed.service._disk, "check", broken)
    bed.run.see(fault="camera a is gone")
    bed.service.supervise()
    status = bed.service.status()
    assert (status.state, status.fault) == (State.FAULTED, "camera a is gone")
    assert {one.text.partition(":")[0] for one in status.troubles} == {"recoveries", "uploads", "disk"}


def test_a_defect_in_watching_is_a_fault(bed: Bed) -> None:
    bed.record()
    bed.run.refuse["poll"] = ZeroDivisionError("oops")
    bed.service.supervise()
    status = bed.service.status()
    assert status.state is State.FAULTED
    assert "ZeroDivisionError" in (status.fault or "")
    assert bed.run.names[-1] == "close"
