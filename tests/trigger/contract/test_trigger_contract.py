"""Requirements for every device behind the driver: the model in its two forms, and the gateware."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from trigger_twins import CLOCK_HZ, CODE, TWINS, Bench, run
from waiting import until

from acquire.codes import ConstantCode, prbs
from acquire.errors import TriggerError
from acquire.sim.trigger_model import prbs_state
from acquire.testing.triggers import TriggerContract, collect
from acquire.trigger import registers as r
from acquire.trigger.base import LineTag
from acquire.trigger.dialogue import RefusedError
from acquire.trigger.driver import TriggerDriver, run_number
from acquire.trigger.registers import Command, EndReason, ErrorCode, State

MASK = sum(1 << tap - 1 for tap in (64, 63, 61, 60))


class TestAnyTrigger(TriggerContract):
    """The requirements for every trigger, checked with every twin."""

    @pytest.fixture
    def trigger(self, bench: Bench) -> TriggerDriver:
        return bench.driver()


def test_the_device_identifies_itself(bench: Bench) -> None:
    driver = bench.driver()
    identity, can = driver.identify(), driver.device().capabilities
    assert identity.clock_hz == CLOCK_HZ
    assert "sync trigger" in identity.model
    assert set(can.substeps) == {1, 2, 3, 6}
    assert can.substep_ticks_min <= 8
    assert can.substep_ticks_max >= 2**20
    assert can.code_bits >= 1 << 19
    assert can.tag_room >= 256


def test_a_run_from_start_to_stop(bench: Bench) -> None:
    driver = bench.driver()
    driver.prepare(run())
    before_ns = time.time_ns()
    fit = driver.start()
    assert fit.clock_hz == CLOCK_HZ
    assert (
        before_ns - fit.uncertainty_ns - 10**7 <= fit.utc_ns_at_tick_0 <= time.time_ns() + fit.uncertainty_ns
    )
    tags = collect(driver, 160)
    lines = driver.stop()
    assert driver.stop() == lines
    tags += driver.tags(0.1)
    assert [tag.line for tag in tags] == list(range(0, lines, 16))
    assert all(tag.code_index == 3 * tag.line for tag in tags)
    assert all(tag.tick == 2700 * tag.line for tag in tags), "jitter"
    statistics = driver.statistics()
    assert (statistics["pulses"], statistics["tag_lost"], statistics["tags_missing"]) == (lines, 0, 0)
    status = driver.device().status()
    assert (status.state, status.end_reason, status.run) == (
        State.ENDED,
        EndReason.STOPPED,
        run_number("run"),
    )


def test_the_prbs_register_has_the_state_computed_by_the_host(bench: Bench) -> None:
    driver = bench.driver(line_budget=300)
    driver.prepare(run())
    driver.start()
    until(lambda: driver.device().status().state == State.ENDED)
    state = driver.device().read(r.CODE_STATE)
    assert state == prbs_state(MASK, CODE.state, 3 * 299)
    ahead = [prbs_state(MASK, state, k) & 1 for k in range(3)]
    assert ahead == prbs(64, CODE.state, 3 * 299, 3).tolist()


@given(
    substeps=st.sampled_from([1, 2, 3, 6]),
    substep_ticks=st.integers(900, 9000),
    budget=st.integers(1, 200),
    every=st.integers(1, 50),
)
@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_line_budget_is_kept_exactly(bench: Bench, substeps, substep_ticks, budget, every) -> None:
    driver = bench.driver(line_budget=budget)
    name = f"budget-{time.monotonic_ns()}"
    every = max(every, 30 // substeps)
    asked = run(name, substeps=substeps, substep_ticks=substep_ticks, tag_every_lines=every)
    driver.prepare(asked)
    driver.start()
    until(lambda: driver.device().status().state == State.ENDED)
    tags = []
    until(lambda: tags.extend(driver.tags(0.01)) or len(tags) == -(-budget // every))
    assert driver.stop() == budget
    period = substeps * substep_ticks
    assert tags == [LineTag(k, k * substeps, k * period) for k in range(0, budget, every)]
    assert driver.device().status().end_reason == EndReason.LINE_BUDGET
    driver.close()


def test_commands_may_be_repeated(bench: Bench) -> None:
    driver = bench.driver()
    driver.prepare(run())
    number = run_number("run")
    driver.device().command(Command.ARM, number)
    driver.device().command(Command.START, number)
    driver.device().command(Command.START, number)
    driver.device().command(Command.ARM, number)
    assert driver.device().status().state == State.RUNNING
    with pytest.raises(RefusedError, match="BUSY"):
        driver.device().command(Command.ARM, 77)
    with pytest.raises(RefusedError, match="WRONG_RUN"):
        driver.device().command(Command.STOP, 77)
    driver.device().command(Command.STOP, number)
    until(lambda: driver.device().status().state == State.ENDED)
    driver.device().command(Command.STOP, number)
    driver.device().command(Command.START, number)
    assert driver.device().status().state == State.ENDED
    with pytest.raises(RefusedError, match="RUN_OVER"):
        driver.device().command(Command.ARM, number)


def test_configuration_is_locked_while_armed(bench: Bench) -> None:
    driver = bench.driver()
    driver.prepare(run())
    link = driver.device().link
    with pytest.raises(RefusedError) as caught:
        link.write(r.SUBSTEP_CLOCKS.address, [800])
    assert (caught.value.code, caught.value.address) == (ErrorCode.BUSY, r.SUBSTEP_CLOCKS.address)
    assert driver.device().read(r.SUBSTEP_CLOCKS) == 900


@pytest.mark.parametrize(
    ("register", "value", "error"),
    [
        (r.SUBSTEP_CLOCKS, 2, ErrorCode.BAD_SUBSTEP),
        (r.LINE, 4, ErrorCode.BAD_SUBSTEPS),
        (r.PHASE_CLOCKS, 451, ErrorCode.BAD_PHASES),
        (r.CODE_SOURCE, 3, ErrorCode.BAD_SOURCE),
        (r.PRBS_SEED, 0, ErrorCode.BAD_SEED),
        (r.PRBS_MASK, 0, ErrorCode.BAD_SEED),
        (r.WINDOW_CLOSE, 901, ErrorCode.BAD_WINDOW),
        (r.WINDOW_OPEN, 900, ErrorCode.BAD_WINDOW),
        (r.TRIGGER_A_WIDTH, 0, ErrorCode.BAD_TRIGGER_A),
        (r.TRIGGER_A_DELAY, 2700, ErrorCode.BAD_TRIGGER_A),
        (r.TRIGGER_B_WIDTH, 2700, ErrorCode.BAD_TRIGGER_B),
        (r.CAMERA_MIN_PERIOD, 2701, ErrorCode.BAD_MIN_PERIOD),
        (r.TAG_INTERVAL, 0, ErrorCode.BAD_TAG_INTERVAL),
    ],
)
def test_the_device_itself_rejects_what_it_cannot_do(bench: Bench, register, value, error) -> None:
    driver = bench.driver()
    driver.prepare(run())
    driver.stop()
    link = driver.device().link
    link.write(register.address, register.to_words(value))
    with pytest.raises(RefusedError) as caught:
        driver.device().command(Command.ARM, 5)
    assert caught.value.code == error
    assert driver.device().read(r.REJECT) & 0xFFFF == error
    assert driver.device().status().state != State.ARMED


@pytest.mark.parametrize(
    ("changes", "config", "words"),
    [
        ({"substep_ticks": 3}, {}, "cannot make a sub-step of 3 ticks; possible: "),
        ({"substeps": 4}, {}, "cannot make 4 sub-steps per line; possible: 1, 2, 3, 6"),
        ({"tag_every_lines": 0}, {}, "cannot send a tag every 0 lines"),
        (
            {},
            {"clock_hz": 50_000_000},
            "trigger.clock_hz is 50000000 Hz, which is not the clock of this device; possible: 90000000",
        ),
        ({}, {"camera_min_period_ticks": 3000}, "2700 ticks apart; possible: 3000"),
        (
            {},
            {"a": {"delay_ticks": 2650}},
            "the pulse of camera A is 90 ticks wide and 2650 late: too much; possible: ",
        ),
        ({}, {"light": {"open_ticks": 950}}, "the light cannot be on from tick 950 to 900"),
    ],
)
def test_the_driver_refuses_in_words_before_it_writes(bench: Bench, changes, config, words) -> None:
    driver = bench.driver(**config)
    before = driver.device().read(r.SUBSTEP_CLOCKS), driver.device().read(r.CODE_SOURCE)
    with pytest.raises(TriggerError, match=words):
        driver.prepare(run(**changes))
    assert (driver.device().read(r.SUBSTEP_CLOCKS), driver.device().read(r.CODE_SOURCE)) == before
    assert driver.device().status().state == State.IDLE


def test_code_memory_loads_checks_and_reads_back(bench: Bench) -> None:
    driver = bench.driver()
    bits = prbs(23, 5, 0, 65_536 - 5)
    driver.device().load_code(bits)
    np.testing.assert_array_equal(driver.device().read_code(len(bits)), bits)
    assert driver.device().status().code_checked
    driver.device().link.write(r.CODE_MEMORY + 7, [0])
    assert not driver.device().status().code_checked


def test_unsupported_settings_are_refused_by_name(bench: Bench) -> None:
    link = bench.driver().device().link
    for address, words, code in (
        (r.ID.address, [1], ErrorCode.READ_ONLY),
        (0x7FFF, [1], ErrorCode.BAD_ADDRESS),
        (r.COMMAND.address, [99], ErrorCode.BAD_COMMAND),
    ):
        with pytest.raises(RefusedError) as caught:
            link.write(address, words)
        assert caught.value.code == code
    with pytest.raises(RefusedError, match="BAD_ADDRESS"):
        link.read(0x7000)


def test_self_test_passes(bench: Bench) -> None:
    assert bench.driver().device().self_test() == {
        "done": 1,
        "memory_failed": 0,
        "prbs_failed": 0,
        "crc_failed": 0,
    }


def test_a_silent_host_ends_the_run(bench: Bench) -> None:
    driver = bench.driver(watchdog_s=bench.watchdog_s)
    driver.prepare(run(code=ConstantCode(1)))
    driver.start()
    link = driver.device().link
    seen = []
    until(lambda: seen.extend(link.tags(0.05)) or (seen and seen[-1].tag.flags & r.TagFlag.LAST))
    assert seen[-1].tag.flags & r.TagFlag.WATCHDOG
    status = driver.device().status()
    assert status.end_reason == EndReason.WATCHDOG
    assert status.lines * 2700 >= bench.watchdog_s * CLOCK_HZ


def test_an_external_edge_starts_an_armed_run(bench: Bench) -> None:
    if bench.external_edge is None:
        pytest.fail("this twin has no external input: give it one")
    driver = bench.driver(external_start="rising")
    driver.prepare(run())
    assert driver.device().status().state == State.ARMED
    starter = threading.Thread(target=driver.start)
    starter.start()
    bench.external_edge()
    starter.join(300)
    assert not starter.is_alive()
    assert collect(driver, 32)[0].tick == 0
    driver.stop()


def test_a_missing_external_edge_is_an_error_after_the_time_limit(bench: Bench) -> None:
    driver = bench.driver(external_start="rising", external_timeout_s=0.1)
    driver.prepare(run())
    with pytest.raises(TriggerError, match=r"did not start within 0\.1 s"):
        driver.start()
    assert driver.stop() == 0


def test_unplugging_is_reported_to_every_waiter_at_once(bench: Bench) -> None:
    driver = bench.driver()
    driver.prepare(run())
    driver.start()
    errors: list[TriggerError] = []

    def pump() -> None:
        try:
            while True:
                driver.tags(600.0)
        except TriggerError as error:
            errors.append(error)

    pumps = [threading.Thread(target=pump) for _ in range(3)]
    for thread in pumps:
        thread.start()
    bench.unplug()
    for thread in pumps:
        thread.join(300)
    assert len(errors) == 3
    begun = time.monotonic()
    with pytest.raises(TriggerError):
        driver.stop()
    assert time.monotonic() - begun < 60
    driver.close()


def test_every_twin_of_the_contract_is_named() -> None:
    assert {"model", "model-pty", "model-socket", "model-usb"} <= set(TWINS)
