"""What a demonstration is to do, and whether it can: everything is refused before anything is touched."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.config import RigConfig

RIG = "rig-demo"
CAMERA_RIGS = {"simulated": RIG, "gentl": "rig-demo-gentl", "gige": "rig-demo-gige"}
SEED = 1
LINES = 33_334
TWIST_BUDGET_S = 30.0

SEGMENT_LINES = 263
"""L_R of Fig. 9: 598 trusted frames."""

SEGMENT_START_S = 0.052
"""Where Fig. 9 cuts, from the start of the recording."""

N_M, T_M = 3, 1
"""Fig. 9: 64 × 64 voxels at the sub-step rate."""

LEAST_SIDE = 11
"""Voxels: the window of SSIM."""

LEAST_FRAMES = 8
"""What the fit of a sinusoid with its harmonics takes."""

RTL_TICKS = 60
"""Clocks of a sub-step where the trigger is its gateware; and the lowest clock that a rig can have."""

RTL_LEAST_HZ = 1_000_000


@dataclass(frozen=True, slots=True)
class DemoPlan:
    """One run: a new directory for everything, the rig, its code's seed, lines, seconds for the solvers."""

    out: Path
    config: str = RIG
    seed: int = SEED
    lines: int = LINES
    budget_s: float | None = None
    twist_budget_s: float = TWIST_BUDGET_S
    trigger: Literal["simulated", "rtl"] = "simulated"

    @property
    def command(self) -> str:
        """The words that do the same again, somewhere else."""
        words = ["acquire", "demo", "--seed", str(self.seed), "--lines", str(self.lines)]
        if self.config != RIG:
            words += ["--config", self.config]
        if self.budget_s is not None:
            words += ["--budget", f"{self.budget_s:g}"]
        if self.twist_budget_s != TWIST_BUDGET_S:
            words += ["--twist-budget", f"{self.twist_budget_s:g}"]
        if self.trigger != "simulated":
            words += ["--trigger", self.trigger]
        return shlex.join(words)


def trigger_settings(plan: DemoPlan) -> dict[str, str | int]:
    """What the demonstration changes in its rig file, as `load_rig` takes it.

    The gateware is computed clock by clock: it gets a slower clock, with few clocks in the same sub-step.
    """
    if plan.trigger == "simulated":
        return {}
    from acquire.config import load_rig

    timing = load_rig(plan.config).trigger
    ticks, clock_hz = timing.substep_ticks, timing.clock_hz
    if ticks % RTL_TICKS == 0 and clock_hz * RTL_TICKS // ticks >= RTL_LEAST_HZ:
        ticks, clock_hz = RTL_TICKS, clock_hz * RTL_TICKS // ticks
    return {"trigger.driver": "rtl", "trigger.clock_hz": clock_hz, "trigger.substep_ticks": ticks}


def rig_of(config: str, cameras: str) -> str:
    """The rig file for the cameras that were asked for. Raises UsageError for a file of the user's own."""
    if cameras == "simulated" or config == CAMERA_RIGS[cameras]:
        return config
    if config != RIG:
        raise UsageError(
            f"the demo cannot give {config} the cameras {cameras!r}: they are those of its file",
            hint="cameras.a.driver in that file, or no --config",
        )
    return CAMERA_RIGS[cameras]


def check(plan: DemoPlan, rig: RigConfig) -> None:
    """Raise UsageError for what could not be carried out to the end."""
    from acquire.config import check_directory

    out = plan.out
    if out.exists():
        raise UsageError(f"demo to {out}: it exists and stays untouched", hint="--out with a new directory")
    if not out.absolute().parent.is_dir():
        raise UsageError(f"demo to {out}: there is no directory {out.absolute().parent}")
    for budget_s in (plan.budget_s, plan.twist_budget_s):
        if budget_s is not None and not budget_s > 0:
            raise UsageError(f"a budget of {budget_s} s is out of range", possible="more than 0")
    _check_rig(plan, rig)
    check_directory(rig)
    if rig.trigger.driver == "rtl":
        from acquire.sim.rtl import demand

        demand()
    _check_cameras(rig)
    least = segment_row(rig) + SEGMENT_LINES
    if plan.lines < least:
        raise UsageError(
            f"the demo cannot be made of {plan.lines} lines",
            possible=f"{least} or more: it cuts {SEGMENT_LINES} at 52 ms",
        )


def segment_row(rig: RigConfig) -> int:
    """Row of the recording at which the segment begins."""
    return round(SEGMENT_START_S * rig.line_rate_hz)


def _check_cameras(rig: RigConfig) -> None:
    drivers = (rig.cameras.a.driver, rig.cameras.b.driver)
    if "gentl-simulated" in drivers:
        from acquire.sim.gentl.build import build

        build()
    if "gige-simulated" in drivers:
        from acquire.camera.aravis import load

        load()


def _check_rig(plan: DemoPlan, rig: RigConfig) -> None:
    if rig.trigger.driver not in ("simulated", "rtl"):
        raise UsageError(
            f"demo cannot use trigger driver {rig.trigger.driver!r}", possible="'simulated', 'rtl'"
        )
    if rig.code.kind != "prbs":
        raise UsageError(
            f"demo cannot use {plan.config} with code.kind = {rig.code.kind!r}", possible="'prbs'"
        )
    geometry = rig.geometry.segment(SEGMENT_LINES)
    if geometry.size % N_M or geometry.size < N_M * LEAST_SIDE:
        raise UsageError(
            f"the demo cannot use {plan.config}, whose n = M·S is {geometry.size}",
            possible=f"a multiple of {N_M}, {N_M * LEAST_SIDE} or more",
        )
    if (frames := geometry.trusted.stop - geometry.trusted.start) < LEAST_FRAMES:
        raise UsageError(
            f"demo of {plan.config}: of {SEGMENT_LINES} lines with M = {geometry.stages} stages, "
            f"{frames} frames can be trusted",
            possible=f"fewer stages: {LEAST_FRAMES} trusted frames or more",
        )
