"""Cost of accuracy in time: the figures' scenes and the truth, on codes on which nothing was tuned.

Usage: python tools/bench_reconstruct.py [fig9 motion detail static pulses chopper digits] [--seeds 1 2]

For every case and code: PSNR over the trusted interval after each budget of time, for the default solver and
the paper's TwIST, and TwIST with the default's band and sign (the gain of the prior without the algorithm).
The solvers get nothing but the lines; budgets are seconds of wall-clock time. Lines come from the streaming
simulator, rounded to 12 bits. Fig. 9 also has the largest error of the three fitted frequencies and the ratio
of fitted to true amplitude at 5 kHz; pulses have the correlation of the light with the truth over lit
sub-steps, with a known still image and 1 % noise.

--against-twist prints one line per case and code instead: the best PSNR of the paper's solver within 400
iterations (the paper makes at most 200), how much sooner the default reaches it, in wall-clock and in
processor time, and the default's PSNR in the time of TwIST's best.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np

from acquire.codes import PrbsCode
from acquire.config import load_scene
from acquire.evaluate.curves import compare_curve, region_mean
from acquire.evaluate.metrics import psnr
from acquire.geometry import Geometry
from acquire.lines import ARMS, Segment
from acquire.recon import Reconstruction, reconstruct
from acquire.sim.leds import LedScene
from acquire.sim.lines import StreamingArm
from acquire.sim.scene import Scene, SeparableScene
from acquire.sim.scenes import build_scene
from acquire.sim.voxels import truth
from tools.results import Run, add_option, recorded

FULL_SCALE_DN = 4095
GAIN_DN = 6.0


@dataclass(frozen=True)
class Case:
    """A scene, its geometry and voxels, and the goals: (budget in s, dB)."""

    scene: str
    geometry: Geometry
    first_line: int
    substep_s: float
    merges: tuple[int, int]
    goals: tuple[tuple[float, float], ...]


CASES = {
    "fig9": Case("scene-leds", Geometry(64, 3, 263), 1733, 1e-5, (3, 1), ((5, 27), (10, 30), (30, 33))),
    "motion": Case("scene-goldfish", Geometry(54, 3, 1313), 30, 1 / 1.8e6, (3, 4), ((5, 26), (15, 29))),
    "detail": Case("scene-goldfish", Geometry(54, 3, 1313), 30, 1 / 1.8e6, (1, 820), ((3, 24),)),
    "static": Case("scene-usaf", Geometry(64, 3, 263), 200, 1 / 1.8e6, (1, 980), ((2, 40),)),
    "digits": Case("scene-digits", Geometry(64, 3, 263), 1733, 1e-5, (3, 1), ((15, 0),)),
    "chopper": Case("scene-chopper", Geometry(64, 3, 254), 900, 1e-5, (3, 1), ((15, 22),)),
}
TWIST_STEPS = (20, 50, 100, 200, 400)
DEFAULT_STEPS = (2, 4, 6, 8, 10, 12, 15, 18, 22, 27, 33, 40, 60, 90, 150, 300)
PULSES = ("scene-pulses-300khz", "scene-pulses-900khz")


def record(case: Case, seed: int) -> tuple[Scene, Segment]:
    """Lines as a 12-bit camera would have recorded them."""
    g = case.geometry
    scene, code = (
        build_scene(load_scene(case.scene), g.size, case.substep_s),
        PrbsCode.from_seed(64, seed),
    )
    arms = [StreamingArm(scene, code, g.stages, g.substeps, arm) for arm in ARMS]
    light = np.stack([arm.lines(case.first_line, g.lines) for arm in arms])
    gain = min(GAIN_DN, 0.9 * FULL_SCALE_DN / light.max())
    lines = np.clip(np.rint(gain * light), 0, FULL_SCALE_DN).astype(np.uint16)
    return scene, Segment(
        lines=lines,
        mask=lines < FULL_SCALE_DN,
        code=code.bits(g.substeps * case.first_line, g.span),
        geometry=g,
        time_ns=np.arange(g.lines, dtype=np.int64) * round(g.substeps * case.substep_s * 1e9),
        substep_ns=case.substep_s * 1e9,
        responsivity_dn=gain,
    )


def judged(result: Reconstruction) -> slice:
    """The trusted frames; all frames if a frame is longer than the trusted interval."""
    return result.trusted if result.trusted.stop > result.trusted.start else slice(None)


def curves(case: Case, scene: LedScene, result: Reconstruction) -> str:
    """Largest error of the frequencies, and the amplitude ratio of the fastest LED."""
    video, N_m = result.video[result.trusted], case.merges[0]
    light = scene.intensity(case.geometry.substeps * case.first_line + result.trusted.start, len(video))
    side = case.geometry.stages
    masks = scene.masks.reshape(len(scene.leds), side, N_m, side, N_m).mean(axis=(2, 4))
    found = [
        compare_curve(led.name, curve, region_mean(video, mask > 0.9), case.substep_s)
        for led, mask, curve in zip(scene.leds, masks, light, strict=True)
    ]
    errors = [abs(curve.frequency_error_hz) for curve in found if not curve.constant]
    return f"{max(errors):8.1f} Hz  5 kHz × {found[0].amplitude_ratio:.2f}"


def compare(name: str, case: Case, seed: int, solvers: list[str], run: Run) -> None:
    scene, segment = record(case, seed)
    voxels = truth(scene, case.geometry.substeps * case.first_line, case.geometry.span, *case.merges)
    for budget_s, goal in case.goals:
        for solver in solvers:
            result = reconstruct(segment, *case.merges, "best", budget_s=budget_s, solver=solver)
            frames = judged(result)
            db = psnr(result.video[frames], voxels[frames])
            more = curves(case, scene, result) if isinstance(scene, LedScene) else ""
            print(
                f"{name:8}{seed:5} {solver:12}{budget_s:6.0f}{result.seconds:7.1f}{result.iterations:6d}"
                f"{db:8.2f}{goal:6.0f}{result.quality.prediction:9.4f}{more}",
                flush=True,
            )
            run.add(
                f"{name}, code {seed}, {solver}",
                budget_s=budget_s,
                took_s=result.seconds,
                iterations=result.iterations,
                psnr_db=db,
                goal_db=goal,
                prediction=result.quality.prediction,
                curves=more.strip(),
            )


@dataclass(frozen=True)
class Trial:
    """PSNR of a reconstruction, with its time."""

    db: float
    seconds: float
    processor_s: float


def against_twist(name: str, case: Case, seed: int, run: Run) -> None:
    scene, segment = record(case, seed)
    voxels = truth(scene, case.geometry.substeps * case.first_line, case.geometry.span, *case.merges)

    def attempt(solver: str, iterations: int, budget_s: float | None = None) -> Trial:
        began = time.process_time()
        result = reconstruct(
            segment, *case.merges, "best", budget_s=budget_s, solver=solver, iterations=iterations
        )
        processor_s = time.process_time() - began
        frames = judged(result)
        return Trial(psnr(result.video[frames], voxels[frames]), result.seconds, processor_s)

    best = max((attempt("twist", n) for n in TWIST_STEPS), key=lambda trial: trial.db)
    ours = (attempt("admm", n) for n in DEFAULT_STEPS)
    equal = next((trial for trial in ours if trial.db >= best.db), None)
    sooner = (
        "never as good"
        if equal is None
        else f"as good after {equal.seconds:.2f} s: {best.seconds / equal.seconds:.0f} times sooner "
        f"({best.processor_s / equal.processor_s:.0f} times less processor time)"
    )
    then = attempt("admm", DEFAULT_STEPS[-1], best.seconds)
    print(
        f"{name:8}{seed:5}  TwIST {best.db:.1f} dB at best, in {best.seconds:.1f} s; default {sooner}; "
        f"in equal time {then.db:.1f} dB, {then.db - best.db:+.1f}",
        flush=True,
    )
    run.add(
        f"{name}, code {seed}",
        twist_db=best.db,
        twist_s=best.seconds,
        twist_processor_s=best.processor_s,
        as_good_after_s=equal and equal.seconds,
        as_good_after_processor_s=equal and equal.processor_s,
        in_equal_time_db=then.db,
    )


def pulses(seed: int, run: Run, noise: float = 0.01) -> None:
    for scene_name in PULSES:
        case = replace(CASES["static"], scene=scene_name)
        scene, segment = record(case, seed)
        assert isinstance(scene, SeparableScene)
        rng = np.random.default_rng(seed)
        noisy = segment.lines + rng.normal(0, noise * segment.lines.mean(), segment.lines.shape)
        noisy_segment = replace(segment, lines=noisy.astype(np.float32))
        result = reconstruct(noisy_segment, 3, 1, static_image=scene.masks[0])
        seen = np.zeros(case.geometry.span, bool)
        seen[result.trusted] = segment.code[result.trusted] > 0
        light = scene.intensity(case.geometry.substeps * case.first_line, case.geometry.span)[0]
        correlation = np.corrcoef(result.video.mean((1, 2))[seen], light[seen])[0, 1]
        print(f"{scene_name}{seed:5}  correlation {correlation:.4f}  {result.seconds:.1f} s", flush=True)
        run.add(f"{scene_name}, code {seed}", correlation=correlation, took_s=result.seconds)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="*", default=[*CASES, "pulses"], metavar="case")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--against-twist", action="store_true")
    parser.add_argument("--solvers", nargs="+", default=["admm", "twist", "twist-band"])
    add_option(parser)
    options = parser.parse_args()
    warm = CASES["fig9"]
    for solver in options.solvers:  # compiles
        reconstruct(record(warm, 0)[1], *warm.merges, solver=solver, iterations=2)
    with recorded("bench_reconstruct", keep=options.record) as run:
        if not options.against_twist:
            print(f"{'case':8}{'code':>5} {'solver':12}{'budget':>6}{'s':>7}{'steps':>6}", end="")
            print(f"{'PSNR dB':>8}{'goal':>6}{'predicts':>9}")
        for name in options.cases:
            for seed in options.seeds:
                if options.against_twist:
                    against_twist(name, CASES[name], seed, run)
                elif name == "pulses":
                    pulses(seed, run)
                else:
                    compare(name, CASES[name], seed, options.solvers, run)


if __name__ == "__main__":
    main()
