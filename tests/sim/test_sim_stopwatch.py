"""Exclusive times: nested work is charged to whoever does it."""

from __future__ import annotations

import pytest

from acquire.sim import stopwatch as module
from acquire.sim.effects.base import Stage
from acquire.sim.light import Illumination
from acquire.sim.stopwatch import Stopwatch


@pytest.fixture
def at(monkeypatch):
    """A clock that work moves."""
    now = [100.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: now[0])

    def spend(seconds):
        now[0] += seconds

    return spend


def test_a_caller_is_not_charged_for_its_callees(at):
    watch = Stopwatch()
    inner = watch.timed("inner", lambda: at(5.0))

    def work():
        at(1.0)
        inner()
        at(2.0)
        inner()

    watch.timed("outer", work)()
    assert watch.seconds == {"outer": 3.0, "inner": 10.0}
    with pytest.raises(ZeroDivisionError):
        watch.timed("broken", lambda: 1 / 0)()
    watch.timed("outer", lambda: at(1.0))()
    assert (watch.seconds["outer"], watch.seconds["broken"]) == (4.0, 0.0)


def test_the_series_of_light_are_timed(at):
    watch = Stopwatch()

    def series(first, count):
        at(1.0)

    def wrap(light):
        def late(first, count):
            at(3.0)
            light.light(first, count)

        return Illumination(light.bits, light.drives, late)

    stages = [watch.stage(Stage(name, "light", wrap)) for name in ("one", "two")]
    light = Illumination(series, series, watch.timed("source", series))
    for stage in stages:
        light = stage.run(light)
    assert not watch.seconds
    light.light(0, 1)
    assert watch.seconds == {"two": 3.0, "one": 3.0, "source": 1.0}
