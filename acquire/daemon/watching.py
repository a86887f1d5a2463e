"""From the rig's configuration to the watcher's settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.lines import ARMS
from acquire.plugins import CAMERAS
from acquire.stream.lightcheck import Judge
from acquire.stream.threshold import ThresholdPlan
from acquire.stream.watcher import WatchPlan

if TYPE_CHECKING:
    from acquire.config import RigConfig

_CHECK_S = 0.25
"""Duration of the lines of a check, so that verdicts come within a second."""
# The judge's Fourier transforms have S values per line: at 100 000 lines/s, those of a quarter of a second
# would take three times as long.
_MOST_LINES = 8192
_LEAST_SENSORS = 8
"""Least number of passes over the sensor whose lines a check takes."""


def watch_plan(config: RigConfig) -> WatchPlan | None:
    """Return the watcher's settings; None if there is nothing to check, and no process to start."""
    threshold = threshold_plan(config)
    # A camera with a test pattern has no light whose code could be checked.
    judge = (
        judge_of(config)
        if config.check.enable
        and all(CAMERAS.load(config.cameras.arm(arm).driver).sees_light for arm in ARMS)
        else None
    )
    if threshold is None and judge is None:
        return None
    passing_hz = config.passing_hz
    # A check compares what passed over the whole sensor, however slow the lines come.
    lines = max(_LEAST_SENSORS * config.geometry.stages, min(_MOST_LINES, round(_CHECK_S * passing_hz)))
    black_dn = {arm: config.cameras.arm(arm).black_level_dn for arm in ARMS}
    return WatchPlan(judge, lines, black_dn, threshold)


def judge_of(config: RigConfig) -> Judge:
    """Return the judge of the code."""
    return Judge(
        stages=config.geometry.stages,
        substeps=config.geometry.substeps,
        code=config.code.build(),
        white_dn=config.cameras.a.white_dn,
        registration={"a": config.check.registration_a, "b": config.check.registration_b},
        fibre=config.laid_out,
    )


def threshold_plan(config: RigConfig) -> ThresholdPlan | None:
    """Return the threshold of the rig's ``[events]``, if it is a source of events."""
    events = config.events
    if "threshold" not in events.sources:
        return None
    return ThresholdPlan(
        arm=events.arm,
        level_dn=events.level_dn,
        hysteresis_dn=events.hysteresis_dn,
        rising=events.edge == "rising",
        average_lines=events.average_lines,
    )
