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
from acquire.lines import LineFlag
from acquire.recon import reconstruct
from acquire.rig import Rig
from acquire.store import Recording, Suspect, open_recording, suspect_lines, verify

PATIENCE_S = 300.0
SETTINGS = {"stream.ring_seconds": 4.0, "stream.reopen_s": 30.0, "recording.chunk_lines": 256}
"""Patience with cameras that compute their lines on a busy machine: an arm stalls after ``reopen_s``."""


@contextmanager
def serving(home: Path, **settings: object) -> Iterator[Service]:
    """A service on the small rig with a long ring, in this process."""
    path = home / "rig.toml"
    path.write_text(
        RIG.format(directory=home, socket=home / "c", scene=builtin_directory() / "scene-leds.toml")
    )
    config = load_rig(path, {**SETTINGS, **settings})
    with Rig(config) as rig:
        service = Service(config, lambda _: Run(config, rig))
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
        assert "which both rings hold now" in refused.err
        assert "stream.ring_seconds" in refused.err
        with daemon.client() as client:
            deadline = time.monotonic() + PATIENCE_S
            while client.status().arms["a"].delivered < 3000:
                assert time.monotonic() < deadline
                time.sleep(0.05)
        assert daemon("mark", "the valve opens").code == 0
        begun = daemon("start", "pre.zarr", "--pre", "200ms", "--post", "300ms")
        assert begun.code == 0, begun.err
        assert daemon("status", "--wait", "sealed", "--timeout", 300).code == 0
    finally:
        daemon.close()
    recording = open_recording(tmp_path / "pre.zarr")
    assert recording.lines == 0.5 * LINE_RATE_HZ
    assert recording.attrs["run_condition"] == "GOOD"
    events = {event.text: event for event in recording.events if event.kind == "mark"}
    assert events["acquire start"].line == recording.first_line + 0.2 * LINE_RATE_HZ


def test_pre_trigger_lines_are_reconstructed_like_any_others(tmp_path: Path) -> None:
    """The same lines of the same scene, once recorded as they came and once taken back from the ring."""
    with serving(tmp_path) as service:
        service.arm()
        service.start(StartRequest(path=tmp_path / "plain.zarr", lines=12_000))
        plain = last_recording(service)
        service.disarm()
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


def test_marks_start_recordings_repeatedly_without_arming_again(tmp_path: Path) -> None:
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


def scene_with(home: Path, effect: str) -> str:
    path = home / "scene.toml"
    path.write_text((builtin_directory() / "scene-leds.toml").read_text() + f"\n[[effects]]\n{effect}\n")
    return str(path)


def until_checked(service: Service) -> dict[str, tuple[str, int]]:
    """Arm → verdict and shift, once both are known."""

    def checks() -> dict[str, tuple[str, int]]:
        arms = service.status().arms
        return {arm: (one.check.verdict, one.check.shift) for arm, one in arms.items() if one.check}

    def known() -> bool:
        return len(checks()) == 2 and all(verdict != "unknown" for verdict, _ in checks().values())

    until(service, known, "verdicts")
    return checks()


def test_late_light_is_reported_flagged_and_taints_the_recording(tmp_path: Path) -> None:
    scene = scene_with(tmp_path, 'kind = "code_errors"\nlate_substeps = 2')
    with serving(tmp_path, **{"simulation.scene": scene, "geometry.stages": 16}) as service:
        service.arm()
        assert until_checked(service) == {"a": ("shifted", 2), "b": ("shifted", 2)}
        service.start(StartRequest(path=tmp_path / "r.zarr", lines=2000))
        until(service, lambda: service.status().state is State.ARMED, "the seal")
    recording = open_recording(tmp_path / "r.zarr")
    assert (recording.attrs["run_condition"], recording.attrs["end_reason"]) == (
        "TAINTED",
        "line budget reached",
    )
    tainted_by = recording.attrs["ledger"]["tainted_by"]
    assert tainted_by["code_contradicted_a"] == tainted_by["code_contradicted_b"] == 2000
    for arm in "ab":
        assert np.all(recording.camera(arm).flags[:] & LineFlag.CODE_CONTRADICTED)
    assert [event.text for event in recording.events if event.kind == "code_check"] == [
        "arm a shifted, arm b shifted"
    ]
    assert suspect_lines(recording) == tuple(
        Suspect(arm, recording.first_line, 2000, "shifted by +2 sub-steps") for arm in "ab"
    )
    assert recording.attrs["ledger"]["code_verified_to"] == {"a": 0, "b": 0}
    assert verify(recording.path).notes == tuple(map(str, suspect_lines(recording)))


def test_light_that_follows_the_code_is_verified_and_every_pulse_has_its_place(tmp_path: Path) -> None:
    with serving(tmp_path, **{"geometry.stages": 16}) as service:
        service.arm()
        assert until_checked(service) == {"a": ("verified", 0), "b": ("verified", 0)}
        service.start(StartRequest(path=tmp_path / "r.zarr", lines=3000, pre_s=0.1))
        assert all(arm.ledger and arm.ledger.balanced for arm in service.status().arms.values())
        recording = last_recording(service)
        service.disarm()
        for arm in service.status().arms.values():
            ledger = arm.ledger
            assert ledger is not None
            assert ledger.balanced
            assert (ledger.stored, ledger.waiting, ledger.lost) == (
                3000,
                0,
                {},
            )  # what was under way is no loss
            assert ledger.issued == 17 + ledger.stored + ledger.discarded + ledger.pending
    assert recording.attrs["ledger"]["tainted_by"] == {}
    assert recording.attrs["ledger"]["trigger"]["tags_missing"] == 0
    block_lines = recording.attrs["config"]["stream"]["block_lines"]
    for camera in recording.attrs["ledger"]["cameras"].values():
        ahead = camera["delivered"] - camera["preroll"] - camera["next_line"]
        assert 0 <= ahead <= block_lines  # one block may have been under way from the camera to the ring
        assert camera["next_line"] >= 3000


def test_crossing_a_level_starts_a_recording(tmp_path: Path) -> None:
    """A chopper blade leaves the light free every now and then; recordings begin before it does."""
    scene = tmp_path / "scene.toml"
    text = (builtin_directory() / "scene-chopper.toml").read_text()
    scene.write_text(text.replace("rotation_hz = 2.5", "rotation_hz = 0.4"))
    settings = {"simulation.scene": str(scene), "check.enable": False}
    with serving(tmp_path, **settings) as service:
        service.arm()
        service.start(StartRequest(path=tmp_path / "plain.zarr", lines=10_000))
        levels = last_recording(service).camera("a").lines[:].mean(axis=1)
    smooth = np.convolve(levels, np.ones(64) / 64, "valid")
    low, high = float(smooth.min()), float(smooth.max())
    assert high > 2 * low
    events = {"sources": ["threshold"], "level_dn": (low + high) / 2, "hysteresis_dn": (high - low) / 4}
    events |= {"pre_s": 0.1, "post_s": 0.05}
    with serving(
        tmp_path, **settings, **{f"events.{key}": value for key, value in events.items()}
    ) as service:
        service.arm()
        until(service, lambda: service.status().state is not State.ARMED, "an event")
        recording = last_recording(service)
    (event,) = [event for event in recording.events if event.kind == "threshold"][:1]
    at = event.line - recording.first_line
    assert event.text == f"arm a above {events['level_dn']:g} DN"
    assert at == 0.1 * LINE_RATE_HZ
    lines = recording.camera("a").lines[:].mean(axis=1)
    assert lines[at - 400 : at - 200].mean() < events["level_dn"] <= lines[at : at + 64].mean()
