"""A cable pulled in the middle of a run, and put back: over a real pseudo-terminal with a fixed name."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from trigger_twins import CLOCK_HZ, run, wired_model

from acquire.config.device import TriggerConfig
from acquire.errors import TriggerError
from acquire.sim.trigger_model import TriggerModel
from acquire.sim.twin_links import PtyTwin
from acquire.trigger import registers as r
from acquire.trigger.driver import TriggerDriver
from acquire.trigger.registers import State
from acquire.trigger.transports.serial import SerialTransport


class Cable:
    """A port with a constant name whose device appears and disappears."""

    def __init__(self, port: Path, model: TriggerModel) -> None:
        self.port, self.model = port, model
        self.twin: PtyTwin | None = None
        self.plug()

    def plug(self) -> None:
        self.twin = PtyTwin(self.model)
        self.port.symlink_to(self.twin.path)

    def unplug(self) -> None:
        if self.twin is not None:
            self.twin.close()
            self.port.unlink()
            self.twin = None

    def driver(self, **settings: object) -> TriggerDriver:
        return TriggerDriver(lambda: SerialTransport(str(self.port), 3_000_000), TriggerConfig(**settings))


@pytest.fixture
def cable(tmp_path: Path) -> Iterator[Cable]:
    with wired_model() as model:
        cable = Cable(tmp_path / "ttyTRIGGER", model)
        yield cable
        cable.unplug()


@pytest.fixture
def driver(cable: Cable) -> Iterator[TriggerDriver]:
    driver = cable.driver()
    yield driver
    driver.close()


def lose_it(cable: Cable, driver: TriggerDriver) -> None:
    """In the middle of a run."""
    driver.prepare(run())
    driver.start()
    lines = 0
    while lines < 100:
        lines = max([tag.line for tag in driver.tags(5.0)], default=0)
    cable.unplug()
    with pytest.raises(TriggerError, match=r"is gone.*; its tags have reported run 'run' with \d+ lines"):
        tags_for_ever(driver)


def tags_for_ever(driver: TriggerDriver) -> None:
    while True:
        driver.tags(5.0)


def test_a_driver_without_its_device_reports_the_last_known_state(cable, driver) -> None:
    lose_it(cable, driver)
    statistics = driver.statistics()
    assert statistics["pulses"] > 100
    assert statistics["tags"] == -(-statistics["pulses"] // 16)
    assert "is gone" in statistics["link_lost"]
    for call in (driver.identify, driver.start, driver.device, lambda: driver.tags(1.0)):
        with pytest.raises(TriggerError):
            call()
    with pytest.raises(TriggerError, match="ttyTRIGGER is not there"):
        driver.reopen()


def test_a_run_continues_without_its_host_and_is_found_again(cable, driver) -> None:
    lose_it(cable, driver)
    known = driver.statistics()["pulses"]
    cable.plug()
    found = driver.reopen()
    assert str(found) == f"run 'run' is running with {found.lines} lines"
    assert (found.continues, found.lines >= known) == (True, True)
    later = driver.tags(5.0)
    assert all((tag.code_index, tag.tick) == (3 * tag.line, 2700 * tag.line) for tag in later)
    lines = driver.stop()
    while tags := driver.tags(0.1):
        later += tags
    now = driver.statistics()
    assert later[-1].line + 16 > lines - 1
    assert now["tags"] + now["tags_missing"] == now["tag_count"], "those of the time without a cable"


def test_a_run_that_ended_in_the_meantime_reports_the_reason(cable) -> None:
    driver = cable.driver(watchdog_s=0.05)
    lose_it(cable, driver)
    cable.plug()
    while cable.model.registers.read(r.STATUS.address, 1)[0] & 7 != State.ENDED:
        cable.model.take()
        time.sleep(0.001)
    found = driver.reopen()
    assert str(found) == f"run 'run' is ended with {found.lines} lines (watchdog)"
    assert not found.continues
    driver.close()


def test_a_stop_that_did_not_reach_the_device_is_repeated(cable, driver) -> None:
    lose_it(cable, driver)
    with pytest.raises(TriggerError, match="is not there"):
        driver.stop()
    cable.plug()
    driver.prepare(run("next"))
    assert driver.device().status().state == State.ARMED
    driver.start()
    assert driver.tags(5.0)[0].line == 0


def test_a_stop_that_did_not_reach_the_device_can_be_repeated_itself(cable, driver) -> None:
    """The second one returned at once, without a word, while the light went on flashing."""
    lose_it(cable, driver)
    for _ in range(2):
        with pytest.raises(TriggerError, match="is not there"):
            driver.stop()
    cable.plug()
    assert driver.stop() > 100
    assert driver.device().status().state == State.ENDED
    driver.release()
    assert driver.stop() == 0, "a run that has been stopped is not stopped again"


def test_a_stop_of_an_armed_run_is_owed_however_often_it_fails(cable, driver) -> None:
    driver.prepare(run())
    cable.unplug()
    for _ in range(3):
        with pytest.raises(TriggerError, match=r"is not there|is gone"):
            driver.stop()
    cable.plug()
    driver.prepare(run("next"))
    assert driver.device().status().state == State.ARMED


def test_a_stop_connects_again_to_switch_the_light_off(cable, driver) -> None:
    lose_it(cable, driver)
    cable.plug()
    assert driver.stop() > 100
    assert driver.device().status().state == State.ENDED


def test_a_run_is_not_ended_without_a_request(cable, driver) -> None:
    lose_it(cable, driver)
    cable.plug()
    with pytest.raises(TriggerError, match=r"while another one runs: number 0x.* is running with \d+"):
        driver.prepare(run("next"))
    assert driver.device().status().state == State.RUNNING


def test_another_program_finds_the_run_and_takes_it_over(cable, driver) -> None:
    driver.prepare(run())
    driver.release()
    other = cable.driver()
    other.prepare(run())
    with pytest.raises(TriggerError, match="'run' is armed with 0 lines, with other settings"):
        other.prepare(run(substep_ticks=800))
    other.start()
    other.release()
    driver.prepare(run())
    assert driver.start().clock_hz == CLOCK_HZ, "it runs already: the same start, told again"
    assert driver.stop() > 0
