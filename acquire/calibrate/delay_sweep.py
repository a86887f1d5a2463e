"""A sweep of the trigger's delays: its settings, and the delay that aligns light and charge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares

from acquire.calibrate.calibration import Finding, Measured
from acquire.calibrate.delay import beyond
from acquire.calibrate.exposure import no_progress
from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.trigger.base import Delays
from acquire.trigger.settings import GATEWARE, pulse_width_ticks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.calibrate.delay import Beyond
    from acquire.calibrate.exposure import Exposure, Progress

SHARES = (0.3, -0.3, 0.2, -0.2, 0.15, -0.15)
"""Delays of the light in the recordings of a sweep, relative to a sub-step."""
FIRST_LINES = 4096
"""Lines of the first recording, which gives a rough delay."""
MOST_LINES = 2**17
LEAST_SHARE = 0.08
"""Least useful delay, relative to a sub-step; the light's rounded edges hide smaller ones."""
WANTED_TICKS = 0.5
"""Uncertainty that a sweep aims at, within a sensible number of lines."""
SWEEP_ERROR = 0.75
"""Uncertainty of a sweep's delay relative to that of one contribution in one recording."""
MOST_LEAD = 255
APART = 4.0
"""Standard errors from which the two sides of a sweep count as different."""


@dataclass(frozen=True, slots=True)
class DelayRange:
    """The possible delays of one trigger, in ticks."""

    clock_hz: int
    substep_ticks: int
    pulse_distance_ticks: int

    @property
    def most_lead(self) -> int:
        """Longest lead of the light in ticks: what the register holds and the sub-step leaves room for."""
        return min(MOST_LEAD, self.substep_ticks - GATEWARE.lead_margin_ticks)

    @property
    def most_delay(self) -> int:
        """Longest delay of a camera's line start in ticks, with its pulse ending before the next begins."""
        return self.pulse_distance_ticks - pulse_width_ticks(None, self.pulse_distance_ticks) - 1

    def delays(self, later: Sequence[float]) -> Delays:
        """Return the delays, within the trigger's range, that start each arm's lines later than their light.

        ``later`` is in ticks, from the light of a line's first sub-step.
        """
        a, b = (max(0, round(each)) for each in later)
        # the lead moves the light, for both arms alike; what is left of either is its own delay
        lead = min(a, b, self.most_lead)
        return Delays(lead, min(a - lead, self.most_delay), min(b - lead, self.most_delay))

    def sweep(self, late: Sequence[float]) -> list[Delays]:
        """Return settings to record, around the delay of each arm's light (``late``) without any.

        If that is out of reach, the settings are whole sub-steps away from it, where an early or late light
        shows the beginnings of its sub-steps just as well.
        """
        reach, side = (self.most_lead + self.most_delay) / self.substep_ticks, max(SHARES)
        around = []
        for each in late:
            substeps = each / self.substep_ticks
            excess = math.ceil(substeps + side - reach)
            if excess <= 0:  # not too late, but perhaps too early to be seen from both sides
                excess = min(0, math.floor(substeps - side))
            around.append(each - excess * self.substep_ticks)
        found = [self.delays([each - share * self.substep_ticks for each in around]) for share in SHARES]
        # within the trigger's limits some settings are the same
        return list(dict.fromkeys(found))

    def whole_substeps(self, late: NDArray[np.float64]) -> int:
        """Return the whole sub-steps of delay that the trigger cannot compensate."""
        too_much = float(late.max()) - self.most_lead - self.most_delay
        return max(0, math.ceil(too_much / self.substep_ticks))


@dataclass(frozen=True, slots=True)
class SweepPoint:
    """One recording of a sweep: the ticks by which each arm's lines were delayed, and their contributions."""

    later: tuple[int, int]
    seen: tuple[Beyond, Beyond]


@dataclass(frozen=True, slots=True)
class Crossing:
    """The delay that aligns light and charge of one arm: ``late_ticks`` is the light's delay without any.

    ``edge_ticks`` is the difference between the sides of the sweep, caused by rounded edges of the light; 0
    if only one side was recorded.
    """

    late_ticks: float
    uncertainty: float
    edge_ticks: float


def setting_of(exposure: Exposure) -> DelayRange:
    """Return the delays that were possible for the trigger of a recording, from its configuration."""
    config = exposure.recording.attrs["config"]
    trigger = config["trigger"]
    each = 1 if trigger["line_start"] == "per-substep" else config["geometry"]["substeps"]
    ticks = trigger["substep_ticks"]
    return DelayRange(trigger["clock_hz"], ticks, ticks * each)


def point_of(exposure: Exposure) -> SweepPoint:
    """Evaluate a recording of a sweep, together with the delays that it was made with."""
    trigger = exposure.recording.attrs["config"]["trigger"]
    lead, a, b = (
        trigger["light"]["lead_ticks"],
        trigger["a"]["delay_ticks"],
        trigger["b"]["delay_ticks"],
    )
    return SweepPoint((lead + a, lead + b), beyond(exposure))


def first_sight(point: SweepPoint, substep_ticks: int) -> list[float]:
    """Estimate from one recording the delay of each arm's light, in ticks, without delays of the trigger."""
    return [
        later + each.late_substeps * substep_ticks
        for later, each in zip(point.later, point.seen, strict=True)
    ]


def lines_for(point: SweepPoint, lines: int, substep_ticks: int) -> int:
    """Return the lines per recording for a sweep that is certain to half a tick, within sensible limits."""
    error_ticks = max(each.error for each in point.seen) * substep_ticks
    # Errors fall with the root of the number of lines.
    wanted = lines * (SWEEP_ERROR * error_ticks / WANTED_TICKS) ** 2
    return int(min(MOST_LINES, max(FIRST_LINES, -(-wanted // 1024) * 1024)))


def delay(exposures: Sequence[Exposure], *, progress: Progress = no_progress) -> Finding:
    """Measure each camera's delay of the light, from recordings with different delays of the trigger.

    This needs a scene at rest that is bright at the edges of the field, and the rig's pseudo-random code.
    Raises UsageError for fewer than two useful recordings of an arm.
    """
    setting = setting_of(exposures[0])
    if any(setting_of(each) != setting for each in exposures):
        raise UsageError(
            "recordings with sub-steps of different length do not form a sweep",
            possible="one trigger.substep_ticks",
        )
    points = []
    for each in exposures:
        points.append(point_of(each))
        progress(len(points), len(exposures))
    return evaluate_sweep(points, exposures, setting)


def evaluate_sweep(
    points: Sequence[SweepPoint], exposures: Sequence[Exposure], setting: DelayRange
) -> Finding:
    """Return the result of a sweep from its points."""
    crossings = [_crossing(points, arm, setting.substep_ticks) for arm in range(len(ARMS))]
    late = np.array([each.late_ticks for each in crossings])
    error = np.array([each.uncertainty for each in crossings])
    facts = {
        "recordings": [exposure.facts() for exposure in exposures],
        "lines": sum(exposure.lines for exposure in exposures),
        "settings": len(points),
        "clock_hz": setting.clock_hz,
        "edge_ticks": {arm: round(each.edge_ticks, 2) for arm, each in zip(ARMS, crossings, strict=True)},
        "whole_substeps": setting.whole_substeps(late),
        "rig": settings_for(late, setting),
    }
    quantities = {"light_late_ticks": Measured(late, error)}
    return Finding("delay", exposures[0].instrument, quantities, facts=facts, warnings=_doubts(error, facts))


def settings_for(late: NDArray[np.float64], setting: DelayRange) -> dict[str, int]:
    """Return the keys of ``[trigger]`` that align light and charge of both arms as far as possible."""
    late = late - setting.whole_substeps(late) * setting.substep_ticks
    # light that is early without any delay cannot be delayed; its beginning is cut off (`light.open_ticks`)
    earlier = max(0.0, -float(late.min()))
    delays = setting.delays((late + earlier).tolist())
    keys = {
        "light.lead_ticks": delays.light_lead_ticks,
        "a.delay_ticks": delays.a_ticks,
        "b.delay_ticks": delays.b_ticks,
    }
    return keys | ({"light.open_ticks": round(earlier)} if round(earlier) > 0 else {})


def _crossing(points: Sequence[SweepPoint], arm: int, substep_ticks: int) -> Crossing:
    """Fit one arm's delay, with which the table in `acquire.calibrate.delay` explains all recordings."""
    # a start only, and for the side of every recording: the edge rows may be darker than the mean row
    sight = float(np.median([first_sight(point, substep_ticks)[arm] for point in points]))
    later = np.array([point.later[arm] + point.seen[arm].whole * substep_ticks for point in points])
    kept = np.abs(sight - later) > LEAST_SHARE * substep_ticks
    later, seen = later[kept], [point.seen[arm] for point, good in zip(points, kept, strict=True) if good]
    if len(set(later)) < 2:
        raise UsageError(
            f"arm {ARMS[arm]}: in no two recordings is the light late, or early, by a fraction of a sub-step",
            hint="record the sweep with acquire calibrate delay, while the daemon runs",
        )
    model = _Model(later, seen, sight, substep_ticks)
    sharp = model.fit(rounded=False)
    # rounded edges show only as a difference between the two sides
    if (later < sight).all() or (later > sight).all():
        return Crossing(*sharp[:2], 0.0)
    rounded = model.fit(rounded=True)
    if abs(rounded[2]) > APART * rounded[3]:
        return Crossing(*rounded[:3])
    return Crossing(*sharp[:2], 0.0)


class _Model:
    """Model of the contributions at both ends of a line, given the delay and four rows' light; see the table.

    ``later`` is the delay of each recording's lines, including whole sub-steps of the light's delay.
    """

    def __init__(
        self, later: NDArray[np.float64], seen: Sequence[Beyond], sight: float, substep_ticks: int
    ) -> None:
        self._later, self._sight, self._ticks = later, sight, substep_ticks
        self._parts = np.array([[each.before, each.first, each.last, each.after] for each in seen])
        self._errors = np.array([each.error for each in seen])
        # decided once, so that no recording changes sides during a fit
        self._is_late = later < sight

    def fit(self, *, rounded: bool) -> tuple[float, float, float, float]:
        """Return the delay and its standard error and, if ``rounded``, the difference of both sides (ticks).

        Rounded edges of the light make late light seem later, and early light earlier.
        """
        # rows as bright as the mean row
        start = [self._sight / self._ticks, 1.0, 1.0, 1.0, 1.0, *([0.0] if rounded else [])]
        found = least_squares(self._residual, start, x_scale=0.1)
        spare = found.fun.size - len(start)
        # A scatter larger than the errors makes them larger; a smaller one is chance, and changes nothing.
        scale = max(1.0, 2 * found.cost / spare) if spare > 0 else 1.0
        slopes = np.asarray(found.jac, np.float64)
        # pinv: if all recordings are on one side, light on some of the four rows never counts
        covariance = np.linalg.pinv(slopes.T @ slopes) * scale
        errors = np.sqrt(np.diag(covariance)) * self._ticks
        late = float(found.x[0]) * self._ticks, float(errors[0])
        return (*late, float(found.x[5]) * self._ticks, float(errors[5])) if rounded else (*late, 0.0, 0.0)

    def _residual(self, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        delay, X0, X1, Y0, Y1, *edge = unknown
        shift = delay - self._later / self._ticks
        if edge:
            shift = shift + np.where(self._is_late, edge[0] / 2, -edge[0] / 2)
        late, early = np.maximum(shift, 0), np.maximum(-shift, 0)
        expected = np.stack(
            [
                late * X0,
                np.where(self._is_late, X0 + late * X1, (1 - early) * X0),
                np.where(self._is_late, (1 - late) * Y0, Y0 + early * Y1),
                early * Y0,
            ],
            axis=1,
        )
        residual: NDArray[np.float64] = ((self._parts - expected) / self._errors[:, None]).ravel()
        return residual


def _doubts(error: NDArray[np.float64], facts: dict[str, Any]) -> tuple[str, ...]:
    doubts = []
    if error.max() > 1:
        doubts.append(
            f"the uncertainty is {error.max():.1f} ticks: more lines or brighter light would reduce it to one"
        )
    edge = {arm: ticks for arm, ticks in facts["edge_ticks"].items() if abs(ticks) > APART * error.max()}
    if edge:
        text = " and ".join(f"{abs(ticks):.0f} ticks in arm {arm}" for arm, ticks in edge.items())
        doubts.append(f"the light does not change at once, but over {text}: check the light's edges")
    if facts["whole_substeps"]:
        doubts.append(
            f"the light is late by {facts['whole_substeps']} sub-steps more than the trigger can compensate; "
            "the code stays shifted by them, as acquire status shows: a faster light driver or isolator helps"
        )
    if "light.open_ticks" in facts["rig"]:
        doubts.append(
            "the light is early for the later camera, which no lead can correct: light.open_ticks cuts off "
            "the early part of every sub-step's light; a later light would lose none"
        )
    return tuple(doubts)
