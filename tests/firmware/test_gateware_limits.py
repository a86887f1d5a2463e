"""What the host and the model suppose of the gateware before they can ask it."""

from __future__ import annotations

from dataclasses import replace

from acquire.sim.trigger_registers import constants
from acquire.trigger import registers as r
from acquire.trigger.settings import GATEWARE, Capabilities
from firmware.top import Build


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
