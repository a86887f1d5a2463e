"""Assumptions of the host and the model about the gateware before they can ask it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from bench import simulate

from acquire.codes import ConstantCode
from acquire.config.device import TriggerConfig
from acquire.errors import TriggerError
from acquire.sim.trigger_registers import constants
from acquire.trigger import registers as r
from acquire.trigger.base import TriggerRun
from acquire.trigger.settings import GATEWARE, Capabilities, register_values
from firmware.boards import ulx3s
from firmware.top import Build, SyncTrigger

RUN = TriggerRun("run", ConstantCode(1), 3, 900, 256)


def test_the_host_knows_the_gateware_s_limits() -> None:
    said = Capabilities.read(Build().constants())
    unknown = {"serial": "", "firmware": "", "board": "", "start_latency_ticks": 0}
    assert replace(said, **unknown) == GATEWARE


def test_the_model_has_the_gateware_s_limits_and_latency() -> None:
    model, gateware = constants(90_000_000, 0), Build().constants()
    assert model[r.LIMITS] == gateware[r.LIMITS]
    assert model[r.CODE_BITS] == gateware[r.CODE_BITS]
    latency = r.CAPABILITIES.start_latency
    assert latency.of(model[r.CAPABILITIES]) == latency.of(gateware[r.CAPABILITIES])


@pytest.mark.parametrize("light_low", [False, True])
def test_the_light_is_dark_from_the_first_clock_on(light_low: bool) -> None:
    """Whichever level that is for the driver that the board was built for."""
    trigger = SyncTrigger(Build(code_words=16, tags=16, rx_bytes=16, light_low=light_low))
    levels = []

    async def power_up(context: Any) -> None:
        for _ in range(20):
            levels.append(context.get(trigger.led))
            await context.tick()

    simulate(trigger, power_up)
    assert set(levels) == {light_low}


@pytest.mark.parametrize(("built_low", "pull"), [(False, "DOWN"), (True, "UP")])
def test_pulls_and_rig_check_match_the_polarity_of_the_build(built_low: bool, pull: str) -> None:
    assert f'"led" IO_TYPE=LVCMOS33 PULLMODE={pull};' in ulx3s.constraints(ulx3s.PINS, built_low)
    said = Capabilities.read(Build(board=r.Board.ULX3S, light_low=built_low).constants())
    right, wrong = ("low", "high") if built_low else ("high", "low")
    values = register_values(RUN, TriggerConfig(light={"active": right}), said, 3e5)
    assert r.LED.invert.of(values[r.LED]) == built_low
    with pytest.raises(TriggerError, match=f"possible: {right}, for which this board was built"):
        register_values(RUN, TriggerConfig(light={"active": wrong}), said, 3e5)


def test_the_watchdog_is_on_unless_it_is_turned_off() -> None:
    assert register_values(RUN, TriggerConfig(), GATEWARE, 3e5)[r.WATCHDOG] == 900_000_000 == r.WATCHDOG.reset
    assert register_values(RUN, TriggerConfig(watchdog_s=0), GATEWARE, 3e5)[r.WATCHDOG] == 0
    with pytest.raises(
        TriggerError, match=r"the watchdog cannot wait for 60 s; possible: up to 47\.72 s at 90000000 Hz"
    ):
        register_values(RUN, TriggerConfig(watchdog_s=60), GATEWARE, 3e5)


def test_a_recorded_watchdog_in_ticks_is_still_readable() -> None:
    assert TriggerConfig.model_validate({"watchdog_ticks": 0}).watchdog_s == 0
    old = TriggerConfig.model_validate({"watchdog_ticks": 45_000_000, "clock_hz": 90_000_000})
    assert (old.watchdog_s, old.watchdog_ticks) == (0.5, 45_000_000)
