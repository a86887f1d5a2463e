"""The plan of a demo run and its checks: an impossible run is refused before any file is created."""

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
"""L_R in Fig. 9, which gives 598 trusted frames."""

SEGMENT_START_S = 0.052
"""Start of the lines used in Fig. 9, after the start of the recording."""

N_M, T_M = 3, 1
"""As in Fig. 9: 64 × 64 voxels at the sub-step rate."""

LEAST_SIDE = 11
"""Minimum side of a frame in voxels: the size of the SSIM window."""

LEAST_FRAMES = 8
"""Minimum number of frames for the fit of a sinusoid with its harmonics."""

RTL_TICKS = 60
"""Clocks per sub-step if the trigger's gateware is simulated."""

RTL_LEAST_HZ = 1_000_000
"""The lowest clock frequency that a rig may have."""


@dataclass(frozen=True, slots=True)
class DemoPlan:
    """One demo run: output directory, rig, seed of the code, lines, time limits of the solvers, trigger."""

    out: Path
    config: str = RIG
    seed: int = SEED
    lines: int = LINES
    budget_s: float | None = None
    twist_budget_s: float = TWIST_BUDGET_S
    trigger: Literal["simulated", "rtl"] = "simulated"

    @property
    def command(self) -> str:
        """Command line that repeats the run in another directory."""
        # Without --cameras: these are those of the rig, which `rig_of` has chosen by then.
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
    """Return the changes of the demo to its rig file, for `load_rig`.

    The gateware is simulated clock by clock, so it gets a slower clock with fewer clocks per sub-step; the
    duration of a sub-step stays the same.
    """
    if plan.trigger == "simulated":
        return {}
    from acquire.config import load_rig

    timing = load_rig(plan.config).trigger
    ticks, clock_hz = timing.substep_ticks, timing.clock_hz
    # Whole clocks only, so that the sub-step lasts exactly as long as in the rig file.
    if ticks % RTL_TICKS == 0 and clock_hz * RTL_TICKS // ticks >= RTL_LEAST_HZ:
        ticks, clock_hz = RTL_TICKS, clock_hz * RTL_TICKS // ticks
    # Every clock is computed, so that other programs may hold up the lines for seconds.
    return {
        "trigger.driver": "rtl",
        "trigger.clock_hz": clock_hz,
        "trigger.substep_ticks": ticks,
        "stream.stall_s": 30,
    }


def rig_of(config: str, cameras: str) -> str:
    """Return the rig file for the requested cameras. Raises UsageError for a file of the user's own."""
    if cameras == "simulated" or config == CAMERA_RIGS[cameras]:
        return config
    if config != RIG:
        raise UsageError(
            f"the demo cannot use {cameras!r} cameras with {config}, which has cameras of its own",
            hint="cameras.a.driver in that file, or leave out --config",
        )
    return CAMERA_RIGS[cameras]


def check(plan: DemoPlan, rig: RigConfig) -> None:
    """Raise UsageError for a run that could not be completed."""
    from acquire.config import check_directory

    out = plan.out
    if out.exists():
        raise UsageError(
            f"the demo cannot be written to {out}, which exists and is not overwritten",
            hint="--out with a new directory",
        )
    from acquire.store.files import no_directory

    if (no := no_directory(out.absolute().parent)) is not None:
        why, _ = no
        raise UsageError(
            f"the demo cannot be written to {out}: {why}", hint="--out in a directory that exists"
        )
    for budget_s in (plan.budget_s, plan.twist_budget_s):
        if budget_s is not None and not budget_s > 0:
            raise UsageError(f"a budget of {budget_s} s is out of range", possible="more than 0")
    _check_rig(plan, rig)
    check_directory(rig)
    # Simulators that have to be compiled, and libraries that may not be installed, are tried before anything
    # is written.
    drivers = (rig.cameras.a.driver, rig.cameras.b.driver)
    if rig.trigger.driver == "rtl":
        from acquire.sim.rtl import demand

        demand()
    if "gentl-simulated" in drivers:
        from acquire.sim.gentl.build import build

        build()
    if "gige-simulated" in drivers:
        from acquire.camera.aravis import load

        load()
    least = segment_row(rig) + SEGMENT_LINES
    if plan.lines < least:
        raise UsageError(
            f"the demo cannot be made with {plan.lines} lines",
            possible=f"{least} or more: it uses {SEGMENT_LINES} lines from 52 ms on",
        )


def segment_row(rig: RigConfig) -> int:
    """Return the row of the recording at which the segment begins."""
    return round(SEGMENT_START_S * rig.line_rate_hz)


def _check_rig(plan: DemoPlan, rig: RigConfig) -> None:
    if rig.trigger.driver not in ("simulated", "rtl"):
        raise UsageError(
            f"the demo cannot use the trigger driver {rig.trigger.driver!r}", possible="'simulated', 'rtl'"
        )
    if rig.code.kind != "prbs":
        raise UsageError(
            f"the demo cannot use {plan.config} with code.kind = {rig.code.kind!r}", possible="'prbs'"
        )
    # What the comparison with the truth needs: whole voxels, frames for SSIM, time for a sinusoid's fit.
    geometry = rig.geometry.segment(SEGMENT_LINES)
    if geometry.size % N_M or geometry.size < N_M * LEAST_SIDE:
        raise UsageError(
            f"the demo cannot use {plan.config}, whose n = M·S is {geometry.size}",
            possible=f"a multiple of {N_M}, at least {N_M * LEAST_SIDE}",
        )
    if (frames := geometry.trusted.stop - geometry.trusted.start) < LEAST_FRAMES:
        raise UsageError(
            f"the demo cannot use {plan.config}: {SEGMENT_LINES} lines with M = {geometry.stages} stages "
            f"have {frames} trusted frames",
            possible=f"fewer stages, for {LEAST_FRAMES} trusted frames or more",
        )
