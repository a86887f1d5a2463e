"""The gateware as a process of its own: cameras see its pins, and it ends with its owner."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from waiting import until

import acquire.sim.rtl
from acquire import __version__
from acquire.cli.demo.capture import record
from acquire.cli.demo.plan import DemoPlan, trigger_settings
from acquire.cli.journal import StepJournal
from acquire.codes import PrbsCode
from acquire.config import load_rig
from acquire.config.device import LineOutputConfig, TriggerConfig
from acquire.errors import DeviceError, TriggerError, UsageError
from acquire.rig import Rig
from acquire.sim.lines import StreamingArm
from acquire.sim.pins import PinPage, PinRun, PinWire
from acquire.sim.rtl import RtlTransport
from acquire.store import open_recording
from acquire.trigger.base import TriggerRun
from acquire.trigger.driver import TriggerDriver

CLOCK_HZ, TICKS = 6_000_000, 60
CODE = PrbsCode.from_seed(64, 3)


@pytest.fixture
def page() -> Iterator[PinPage]:
    made = PinPage()
    yield made
    made.close()


@pytest.fixture
def opened() -> list[RtlTransport]:
    """Return everything that the driver has opened, in order."""
    return []


@pytest.fixture
def driver(page: PinPage, opened: list[RtlTransport]) -> Iterator[TriggerDriver]:
    def connect() -> RtlTransport:
        opened.append(RtlTransport(CLOCK_HZ, page))
        return opened[-1]

    config = TriggerConfig(
        driver="rtl",
        clock_hz=CLOCK_HZ,
        substep_ticks=TICKS,
        a=LineOutputConfig(delay_ticks=0),
        b=LineOutputConfig(delay_ticks=30),
    )
    made = TriggerDriver(connect, config)
    yield made
    made.close()


def test_cameras_see_the_pulses_and_the_light_that_the_pins_gave(
    driver: TriggerDriver, page: PinPage
) -> None:
    wires = [PinWire(page, arm) for arm in "ab"]
    assert wires[0].read().train is None
    for number in (1, 2):
        driver.prepare(TriggerRun(f"run {number}", CODE, 3, TICKS, 64))
        driver.start()
        reading = wires[0].wait(number, 500, timeout_s=20)
        assert reading.running
        assert reading.issued >= 500
        assert reading.train is not None
        lit = wires[0].code(reading.train).bits(-9, 1500)
        np.testing.assert_array_equal(lit, CODE.bits(-9, 1500))
        lines = driver.stop()
        ended = [wire.wait(number, 1 << 40, timeout_s=5) for wire in wires]
        assert all(reading.stopped and reading.issued == lines for reading in ended)
        assert reading.train.line_period_ns == 30_000
        trains = [wire.read().train for wire in wires]
        assert [train and train.settled_s for train in trains] == [{"a": 0.0}, {"b": 5e-6}]
        after = wires[1].code(reading.train).bits(3 * lines - 6, 20)
        np.testing.assert_array_equal(after[:6], CODE.bits(3 * lines - 6, 6))
        assert not after[6:].any()


def test_reading_light_that_was_discarded_is_an_error(page: PinPage) -> None:
    page.publish(PinRun(1, True, (5, 5), 60), bytes(100), CLOCK_HZ)
    page.publish(PinRun(2, True, (1, 1), 60), bytes(10), CLOCK_HZ)
    with pytest.raises(DeviceError, match="run 1 of the trigger is over"):
        page.light(1, 0, 5)
    for _ in range(9):
        page.publish(PinRun(2, True, (1, 1), 60), bytes(1 << 20), CLOCK_HZ)
    with pytest.raises(DeviceError, match="too late"):
        page.light(2, 0, 5)


def test_light_that_the_next_run_overwrites_while_it_is_read_is_an_error(
    page: PinPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    awaited = page._await_light

    def then_overwritten(run: int, end: int) -> NDArray[np.uint64]:
        fields = awaited(run, end)
        page.publish(PinRun(2, True, (1, 1), 60), bytes(50), CLOCK_HZ)
        return fields

    page.publish(PinRun(1, False, (5, 5), 60), bytes([1]) * 100, CLOCK_HZ)
    assert page.light(1, 0, 100).all()
    monkeypatch.setattr(page, "_await_light", then_overwritten)
    with pytest.raises(DeviceError, match="run 1 of the trigger is over"):
        page.light(1, 0, 100)


def test_it_ends_when_its_owner_is_killed() -> None:
    text = (
        "import time\n"
        "from acquire.sim.rtl import RtlTransport\n"
        f"transport = RtlTransport({CLOCK_HZ})\n"
        "print(transport._process.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    owner = subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True)
    try:
        assert owner.stdout is not None
        twin = int(owner.stdout.readline())
        assert Path(f"/proc/{twin}").exists()
        owner.send_signal(signal.SIGKILL)
        until(lambda: not _lives(twin))
    finally:
        owner.kill()
        owner.communicate()


def _lives(process: int) -> bool:
    try:
        return "\nState:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False


def test_a_process_that_dies_is_an_unplugged_trigger(
    driver: TriggerDriver, opened: list[RtlTransport]
) -> None:
    driver.prepare(TriggerRun("run", CODE, 3, TICKS, 64))
    driver.start()
    opened[0]._process.kill()
    with pytest.raises(TriggerError, match="is gone"):
        until(lambda: driver.tags(1.0) is None)
    assert not driver.reopen().continues


def test_without_a_compiler_the_rig_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match=r"this host lacks g\+\+ \(Debian, Ubuntu: apt install g\+\+\)"):
        RtlTransport(CLOCK_HZ)
    monkeypatch.setattr(acquire.sim.rtl, "ROOT", tmp_path)
    with pytest.raises(UsageError, match="they are in a checkout") as caught:
        RtlTransport(CLOCK_HZ)
    assert "'simulated'" in caught.value.possible
    assert f"tdi-acquire=={__version__}" in caught.value.hint  # an installed package states how to get them


def test_a_cache_that_cannot_be_written_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "cache").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(TriggerError, match=r"cache/acquire/rtl cannot be written: .*XDG_CACHE_HOME"):
        RtlTransport(CLOCK_HZ)


def test_a_process_that_dies_at_its_start_is_not_said_to_be_slow(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "firmware").mkdir()
    (tmp_path / "firmware" / "__init__.py").touch()
    (tmp_path / "firmware" / "twin.py").write_text("raise SystemExit(3)")
    monkeypatch.setattr(acquire.sim.rtl, "ROOT", tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    with pytest.raises(TriggerError, match="ended before it could report anything"):
        RtlTransport(CLOCK_HZ)


def test_a_folder_of_the_same_name_where_one_works_does_no_harm(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "firmware").mkdir()
    (tmp_path / "firmware" / "__init__.py").write_text("raise SystemExit('of another project')")
    monkeypatch.chdir(tmp_path)
    RtlTransport(CLOCK_HZ).close()


def test_the_demo_records_from_the_gateware(tmp_path: Path) -> None:
    """Every pixel follows Eq. (1) with the requested code; the light came from the LED's pin."""
    out = tmp_path / "out"
    out.mkdir()
    captured = record(DemoPlan(out, lines=700, trigger="rtl"), StepJournal())
    recording = open_recording(captured.path)
    assert captured.status.last is not None
    assert captured.status.last.condition == "GOOD"
    assert recording.lines == 700
    assert recording.attrs["trigger"]["model"] == "sync trigger (none)"
    assert recording.attrs["config"]["trigger"]["driver"] == "rtl"
    plan = DemoPlan(out, trigger="rtl")
    config = load_rig(plan.config, {"code.seed": plan.seed, **trigger_settings(plan)})
    with Rig(config) as rig:
        scene = rig.scene()
    for arm in "ab":
        camera, asked = recording.camera(arm), config.cameras.arm(arm)
        first = int(camera.line_number[0])
        np.testing.assert_array_equal(camera.code_index[:], 3 * np.arange(first, first + 700))
        light = StreamingArm(scene, config.code.build(), 64, 3, arm).lines(first, 700)
        assert light.std() > 1
        dn = np.clip(light * np.float64(asked.responsivity_dn), 0, asked.white_dn)
        # Half a DN is rounding; which way a half goes depends on the order in which blocks were summed.
        np.testing.assert_allclose(camera.lines[:], dn, rtol=0, atol=0.5 + 1e-3)


def test_a_killed_demo_leaves_nothing_behind(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "acquire", "demo", "--trigger", "rtl", "--lines", "3000000"]
    demo = subprocess.Popen([*command, "--out", str(tmp_path / "out")], stderr=subprocess.DEVNULL)
    try:
        until(lambda: list((tmp_path).glob("out/recording.zarr/*")))
        family = _descendants(demo.pid)
        assert any("firmware.twin" in _command(process) for process in family)
        demo.send_signal(signal.SIGKILL)
        demo.wait()
        until(lambda: not any(_lives(process) for process in family))
    finally:
        demo.kill()
        demo.wait()


def _descendants(process: int) -> list[int]:
    found = []
    for task in Path(f"/proc/{process}/task").iterdir():
        for child in map(int, (task / "children").read_text().split()):
            found += [child, *_descendants(child)]
    return found


def _command(process: int) -> str:
    return Path(f"/proc/{process}/cmdline").read_bytes().decode().replace("\0", " ")
