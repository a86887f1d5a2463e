"""The driver's runs on the model of the device: what it survives, reports and refuses."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trigger_twins import CLOCK_HZ, CODE, run, wired_model

import acquire.trigger.driver
from acquire.codes import code_from_attrs
from acquire.config.device import TriggerConfig
from acquire.errors import TriggerError
from acquire.sim.clock import Wire
from acquire.sim.trigger_model import TriggerModel
from acquire.sim.twin_links import TwinTransport
from acquire.trigger import registers as r
from acquire.trigger.dialogue import TagArrival
from acquire.trigger.driver import TriggerDriver, run_number
from acquire.trigger.registers import State, TagFlag
from acquire.trigger.settings import register_values
from acquire.trigger.tags import TagReader


def driver_of(twin, **settings) -> TriggerDriver:
    return TriggerDriver(lambda: TwinTransport(twin), TriggerConfig(**settings))


def test_a_run_survives_an_unplugged_cable_and_its_state_is_reported() -> None:
    with wired_model() as model:
        driver = driver_of(model)
        driver.prepare(run())
        driver.start()
        driver.tags(5.0)
        driver.device().link.transport.unplug()
        with pytest.raises(TriggerError, match="gone: unplugged"):
            driver.stop()
        with pytest.raises(TriggerError, match="gone: unplugged"):
            driver.tags(1.0)
        assert "run 'run' is running with" in str(driver.reopen())
        assert all(tag.tick == 2700 * tag.line for tag in driver.tags(5.0))
        driver.stop()
        assert "run 'run' is ended with" in str(driver.reopen())
        assert "(stopped)" in str(driver.reopen())
        driver.close()


def test_a_restarted_device_is_detected() -> None:
    with wired_model() as model, wired_model() as fresh:
        twins = [model, fresh]
        driver = TriggerDriver(lambda: TwinTransport(twins.pop(0)), TriggerConfig())
        driver.prepare(run())
        driver.start()
        assert "is over: the device was restarted" in str(driver.reopen())
        assert driver.tags(0) == []
        driver.close()


def test_a_run_of_another_program_is_detected() -> None:
    with wired_model() as model:
        driver, other = driver_of(model), driver_of(model)
        driver.prepare(run())
        driver.start()
        other.device().command(r.Command.STOP)
        while other.device().status().state != State.ENDED:
            time.sleep(0.001)
        other.prepare(run("another"))
        assert "or was given another run" in str(driver.reopen())
        other.close()
        driver.close()


class Impostor:
    """A model whose constants are changed."""

    def __init__(self, model: TriggerModel, register: r.Register, value: int) -> None:
        self.model = model
        model.registers.put(register, value)

    def feed(self, data: bytes) -> None:
        self.model.feed(data)

    def take(self) -> bytes:
        return self.model.take()


@pytest.mark.parametrize(
    ("register", "value", "words"),
    [
        (r.ID, 7, "answers with ID 0x00000007, not the trigger's 0x54494454"),
        (r.MAP, 7, f"register map 0x00000007, but this program has protocol 1 with map {r.MAP_CRC:#010x}"),
        (r.VERSION, 2, "has protocol 2 with register map"),
    ],
)
def test_a_mismatch_names_both_sides(register, value, words) -> None:
    with wired_model() as model:
        driver = driver_of(Impostor(model, register, value))
        with pytest.raises(TriggerError, match=words):
            driver.identify()
        driver.close()


def test_a_setting_that_does_not_read_back_is_an_error() -> None:
    with wired_model() as model:
        driver = driver_of(model, light={"open_ticks": 100})
        kept = model.registers.write

        def forgetful(address, word):
            kept(address, 0 if address == r.WINDOW_OPEN.address else word)

        model.registers.write = forgetful
        with pytest.raises(TriggerError, match="WINDOW_OPEN reads 0x0 where 0x64 was written"):
            driver.prepare(run())
        driver.close()


def test_nothing_is_opened_before_it_is_needed_or_after_it_was_closed() -> None:
    def connect():
        raise AssertionError("opened")

    driver = TriggerDriver(connect, TriggerConfig())
    assert driver.stop() == 0
    assert driver.tags(0.0) == []
    assert driver.statistics()["pulses"] == 0
    driver.close()
    with pytest.raises(TriggerError, match="without a run"):
        driver.start()


def test_tags_faster_than_the_link_are_refused() -> None:
    with wired_model() as model:
        driver = driver_of(model)
        device = driver.device().capabilities
        config = TriggerConfig()
        with pytest.raises(TriggerError, match="possible: every 9 lines over a link of 300000 bytes/s"):
            register_values(run(tag_every_lines=8), config, device, 300_000)
        values = register_values(run(tag_every_lines=9), config, device, 300_000)
        assert values.keys() == set(r.CONFIGURATION)
        asked = TriggerConfig.model_validate({"light": {"scene_gate": True}})
        with pytest.raises(TriggerError, match="scene gate"):
            register_values(run(), asked, replace(device, inputs=()), 1e9)
        driver.close()


def tag_of(line: int, timestamp: int = 0, flags: int = TagFlag.LINE, **changes: int) -> r.TagRecord:
    return r.TagRecord(5, line, 3 * line, timestamp, flags)._replace(**changes)


def test_time_stamps_wrap_after_weeks_and_ticks_go_on() -> None:
    start_tick = 2**48 - 100
    tags = TagReader(run(), 5, start_tick)
    lines = (0, 1, 10**6, 2**40 // 2700, 2**50 // 2700)
    sent = [
        TagArrival(k, tag_of(line, (start_tick + line * 2700 + k) % 2**48)) for k, line in enumerate(lines)
    ]
    assert [tag.tick for tag in tags.take(sent)] == [line * 2700 + k for k, line in enumerate(lines)]


def test_simulated_time_runs_fast_and_the_fit_holds_at_the_start() -> None:
    wire = Wire()
    model = TriggerModel(wire, CLOCK_HZ, speed=50.0)
    driver = driver_of(model)
    driver.prepare(run(tag_every_lines=1024))  # 100 000 tags a second are more than a busy host takes
    before_ns = time.time_ns()
    fit = driver.start()
    assert fit.utc_ns_at_tick_0 == pytest.approx(
        wire.read().train.start_ns + time.time_ns() - time.monotonic_ns(), abs=2e6
    )
    assert fit.utc_ns_at_tick_0 - before_ns < 5e9
    assert fit.uncertainty_ns < 10**7
    driver.stop()
    driver.close()
    wire.close()


def test_a_stop_waits_for_the_end_of_a_line_by_the_devices_clock_whoever_started_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The limit was a time of the host's, and without the line of a run that another program started."""
    monkeypatch.setattr(acquire.trigger.driver, "ANSWER_S", 0.3)
    wire = Wire()
    model = TriggerModel(wire, CLOCK_HZ, speed=2e-5)  # a line of 30 us takes 1.5 s
    driver, another = driver_of(model), driver_of(model)
    driver.prepare(run())
    driver.start()
    begin = time.monotonic()
    another.identify()
    assert another.stop() == 1
    assert time.monotonic() - begin > 1.0
    another.close()
    driver.close()
    wire.close()


def test_a_stop_does_not_wait_for_a_device_whose_clock_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acquire.trigger.driver, "ANSWER_S", 0.2)
    with wired_model() as model:
        driver = driver_of(model)
        driver.prepare(run())
        driver.start()
        device = driver.device()
        running, ticks = device.status(), device.read(r.TIME)
        monkeypatch.setattr(device, "status", lambda: running)
        monkeypatch.setattr(device, "read", lambda register: ticks)
        with pytest.raises(TriggerError, match=r"did not end within 0\.\d+ s: running with"):
            driver.stop()
        monkeypatch.undo()
        driver.close()


def test_the_wire_carries_the_settings_of_the_registers() -> None:
    wire = Wire()
    driver = driver_of(TriggerModel(wire, CLOCK_HZ))
    driver.prepare(run())
    driver.start()
    train = wire.read().train
    assert float(train.line_period_ns) == 30_000.0
    assert (
        code_from_attrs(train.code) == CODE
    )  # whatever number its user gave is nothing that a register holds
    lines = driver.stop()
    assert (wire.read().issued, wire.read().stopped) == (lines, True)
    driver.close()
    wire.close()


def test_a_stop_ends_the_wait_for_an_external_start() -> None:
    with wired_model() as model:
        driver = driver_of(model, external_start="rising", external_timeout_s=600.0)
        driver.prepare(run())
        errors: list[TriggerError] = []

        def wait() -> None:
            try:
                driver.start()
            except TriggerError as error:
                errors.append(error)

        waiter = threading.Thread(target=wait)
        begun = time.monotonic()
        waiter.start()
        assert driver.stop() == 0
        waiter.join(300)
        assert time.monotonic() - begun < 300
        assert "stopped before its first line" in str(errors[0]) or "without a run" in str(errors[0])
        driver.close()


def test_waiting_for_tags_feeds_the_watchdog_however_rare_they_are() -> None:
    with wired_model() as model:
        driver = driver_of(model, watchdog_s=3.0)
        driver.prepare(run(tag_every_lines=60_000))
        driver.start()
        heard = model.frames_heard
        while model.frames_heard < heard + 3:
            driver.tags(30.0)
        driver.close()


def test_tags_that_are_missing_repeated_or_wrong_are_counted_and_only_good_ones_pass() -> None:
    tags = TagReader(run(), 5, 0)
    sent = [
        TagArrival(0, tag_of(0)),
        TagArrival(1, tag_of(16)),
        TagArrival(1, tag_of(16)),
        TagArrival(4, tag_of(64)),
        TagArrival(2, tag_of(32)),
        TagArrival(5, tag_of(80, code_index=241)),
        TagArrival(6, tag_of(90, flags=TagFlag.PPS)),
        TagArrival(7, tag_of(96, run=6)),
        TagArrival(7, tag_of(96)),
    ]
    assert [tag.line for tag in tags.take(sent)] == [0, 16, 64, 96]
    assert tags.statistics() == {"tags": 5, "tags_missing": 2, "tags_repeated": 2, "tags_wrong": 1}
    assert (tags.lines_known, str(tags)) == (97, "run 'run' with 97 lines")


def test_after_more_missing_tags_than_half_a_turn_of_their_numbers_the_next_are_no_repetitions() -> None:
    tags = TagReader(run(), 5, 0)
    sent = [TagArrival(line % 2**16, tag_of(line)) for line in (0, 50_000, 50_001, 50_000)]
    sent.append(TagArrival(50_000, tag_of(60_000, code_index=1)))  # an old number, and a line that is wrong
    assert [tag.line for tag in tags.take(sent)] == [0, 50_000, 50_001]
    assert tags.statistics() == {"tags": 3, "tags_missing": 49_999, "tags_repeated": 2, "tags_wrong": 0}


@given(st.lists(st.booleans(), max_size=300), st.integers(0, 2**17))
def test_every_tag_is_received_or_missing(arrives, first) -> None:
    tags = TagReader(run(), 5, 0)
    tags._next = first % 2**16
    sent = [TagArrival((first + k) % 2**16, tag_of(k)) for k, here in enumerate(arrives) if here]
    assert [tag.line for tag in tags.take(sent)] == [k for k, here in enumerate(arrives) if here]
    last = max((k for k, here in enumerate(arrives) if here), default=-1)
    counts = tags.statistics()
    assert counts["tags"] + counts["tags_missing"] == last + 1


def test_run_numbers_differ_and_are_never_0() -> None:
    numbers = {run_number(f"run-{k}") for k in range(1000)}
    assert len(numbers) == 1000
    assert 0 not in numbers
