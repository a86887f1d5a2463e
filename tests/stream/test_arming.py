"""Arming that fails, and plans that could not be armed: everything is undone, and the reason is given."""

from __future__ import annotations

from dataclasses import replace

import pytest
from wired_devices import CODE, make_bench

from acquire.errors import AcquireError, CameraError, DeviceError, TriggerError, UsageError
from acquire.stream import Capture, CaptureStatus
from acquire.trigger.base import TriggerRun


@pytest.mark.parametrize(
    ("fault", "kind", "text"),
    [
        ("refuse", CameraError, "camera b is in use; possible: another; try: unplug it"),
        ("bug", AcquireError, "grabber b: ZeroDivisionError: a bug"),
        (
            "die",
            DeviceError,
            "grabber b: killed by SIGKILL; try: look into the log of this program, and the kernel's",
        ),
        (
            "hang",
            DeviceError,
            "grabber b: it did not answer in time; try: again, on a host that is less busy",
        ),
        ("trigger", TriggerError, "the run is too fast"),
    ],
)
def test_arm_undoes_everything_when_something_fails(
    monkeypatch: pytest.MonkeyPatch, fault: str, kind: type[AcquireError], text: str
) -> None:
    if fault == "hang":  # until it is killed
        monkeypatch.setattr("acquire.stream.capture._UNDO_S", 2.0)
        monkeypatch.setattr("acquire.stream.capture._LEAST_END_S", 2.0)
    bench = make_bench(fault_b=fault)
    bench.trigger.refuse = fault == "trigger"
    capture = Capture(bench.plan, bench.trigger)
    with pytest.raises(kind) as failure:
        capture.arm(timeout_s=6.0 if fault == "hang" else 60.0)
    later = "; then, while undoing it: grabber b: the process did not end when told to, and was killed"
    text = text.replace("; try", f"{later}; try") if fault == "hang" else text
    assert str(failure.value) == text
    assert bench.trigger.stops == (fault == "trigger")
    assert capture.poll() == CaptureStatus()
    bench.wire.close()


@pytest.mark.parametrize("refused", [False, True])
def test_what_cannot_be_ended_is_reported_with_the_error_before_it(*, refused: bool) -> None:
    """Only the first was, and that of a camera at the usual end to nobody: it was left running."""
    bench = make_bench()
    bench.wire["stuck_b"] = bench.trigger.stuck = True
    bench.trigger.refuse = refused
    capture = Capture(bench.plan, bench.trigger)
    first = "the run is too fast; then, while undoing it: " if refused else ""
    if refused:
        with pytest.raises(TriggerError) as failure:
            capture.arm(timeout_s=60.0)
    else:
        capture.arm(timeout_s=60.0)
        with pytest.raises(TriggerError) as failure:
            capture.close()
    left = "the trigger does not answer; then, while ending: the camera does not stop"
    assert str(failure.value) == first + left
    assert bench.trigger.stops == 1
    bench.wire.close()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"openers": {"a": None}}, "cameras a"),
        ({"dtype": "float32"}, "float32"),
        ({"ring_slots": 0}, "0 slots"),
        ({"ring_slots": 1, "block_lines": 100}, "cannot have a tag every 100 lines"),
        ({"run": TriggerRun("r", CODE, 9, 900, 100)}, "S = 9"),
    ],
)
def test_plans_that_cannot_work_are_refused(change: dict[str, object], text: str) -> None:
    bench = make_bench()
    with pytest.raises(UsageError, match=text):
        replace(bench.plan, **change)
    bench.wire.close()
