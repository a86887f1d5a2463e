"""Before, during and after an event: real processes, simulated devices, recordings opened again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from live_daemon import LINE_RATE_HZ, RIG, Daemon

from acquire.config import builtin_directory, load_rig
from acquire.daemon.messages import StartRequest
from acquire.daemon.plan import Run
from acquire.daemon.service import Service
from acquire.daemon.states import State
from acquire.recon import reconstruct
from acquire.rig import Rig
from acquire.store import Recording, open_recording

PATIENCE_S = 60.0
SETTINGS = {"stream.ring_seconds": 4.0, "recording.chunk_lines": 256}


@contextmanager
def serving(home: Path, **settings: object) -> Iterator[Service]:
    """A service on the small rig with a long ring, in this process."""
    path = home / "rig.toml"
    path.write_text(
        RIG.format(directory=home, socket=home / "c", scene=builtin_directory() / "scene-leds.toml")
    )
    config = load_rig(path, {**SETTINGS, **settings})
    with Rig(config) as rig:
        service = Service(config, lambda: Run(config, rig))
        try:
            yield service
        finally:
            service.shutdown()


def until(service: Service, condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited {PATIENCE_S} s for {what}: {service.status()}"
        service.supervise()
        time.sleep(0.01)


def until_lines(service: Service, lines: int) -> None:
    def enough() -> bool:
        return all(arm.delivered > lines for arm in service.status().arms.values())

    until(service, enough, f"{lines} lines")


def last_recording(service: Service) -> Recording:
    until(service, lambda: service.status().state in (State.IDLE, State.ARMED), "the seal")
    last = service.status().last
    assert last is not None
    assert last.condition == "GOOD", last.end_reason
    return open_recording(last.path)


def test_commands_of_a_user(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    try:
        assert daemon("arm").code == 0
        refused = daemon("start", "--pre", "1h")
        assert refused.code == 2
        assert "3.6e+07 lines" not in refused.err
        assert "which the ring holds now" in refused.err
        assert "stream.ring_seconds" in refused.err
        with daemon.client() as client:
            deadline = time.monotonic() + PATIENCE_S
            while client.status().arms["a"].delivered < 3000:
                assert time.monotonic() < deadline
        assert daemon("mark", "the valve opens").code == 0
        begun = daemon("start", "pre.zarr", "--pre", "200ms", "--post", "300ms")
        assert begun.code == 0, begun.err
        assert daemon("status", "--wait", "idle", "--timeout", 60).code == 0
    finally:
        daemon.close()
    recording = open_recording(tmp_path / "pre.zarr")
    assert recording.lines == 0.5 * LINE_RATE_HZ
    assert recording.attrs["run_condition"] == "GOOD"
    events = {event.text: event for event in recording.events if event.kind == "mark"}
    assert events["acquire start"].line == recording.first_line + 0.2 * LINE_RATE_HZ


def test_lines_from_before_reconstruct_as_any_other(tmp_path: Path) -> None:
    """The same lines of the same scene, once recorded as they came and once taken back from the ring."""
    with serving(tmp_path) as service:
        service.arm()
        service.start(StartRequest(path=tmp_path / "plain.zarr", lines=12_000))
        plain = last_recording(service)
        service.arm()
        until_lines(service, 9000)
        service.start(StartRequest(path=tmp_path / "pre.zarr", pre_s=0.6, post_s=0.1))
        early = last_recording(service)
    assert early.lines == 7000
    first = max(early.first_line, plain.first_line) + 100
    assert first + 40 < min(early.first_line + 6000, plain.first_line + plain.lines)
    one, other = (recording.cut(first_line=first, lines=40) for recording in (plain, early))
    assert one.mask.all()
    assert np.array_equal(one.lines, other.lines)
    assert np.array_equal(one.code, other.code)
    assert np.array_equal(one.time_ns - one.time_ns[0], other.time_ns - other.time_ns[0])
    videos = [
        reconstruct(segment, spatial_merge=4, temporal_merge=4, preset="fast").video
        for segment in (one, other)
    ]
    assert np.array_equal(*videos)


def test_marks_record_again_and_again_without_being_armed_again(tmp_path: Path) -> None:
    events = {"sources": ["mark"], "pre_s": 0.2, "post_s": 0.1, "rearm": True}
    with serving(tmp_path, **{f"events.{key}": value for key, value in events.items()}) as service:
        service.arm()
        run_id = service.status().run_id
        for number in range(2):
            until_lines(service, 4000 + 4000 * number)
            service.mark(f"bang {number}")
            assert service.status().state is State.RECORDING
            recording = last_recording(service)
            assert service.status().state is State.ARMED
            (mark,) = [event for event in recording.events if event.kind == "mark"]
            assert mark.text == f"bang {number}"
            assert (mark.line - recording.first_line, recording.lines) == (2000, 3000)
            assert recording.attrs["run_id"] == run_id
        service.disarm()
