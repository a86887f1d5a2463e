"""Compare the estimated error of a video with the true error, on scenes to which the estimate was not fitted.

    OMP_NUM_THREADS=1 python tools/bench_error.py [--scenes swing pan …] [--seeds 901] [--record]
    OMP_NUM_THREADS=1 python tools/bench_error.py --fit

It uses the scenes of `tools.error_scenes` that were excluded from the fit, with an ordinary camera's noise
(full well 10⁴ e, 10 e read), with less light (10³ e) and clean, in voxels of 3 × 1 and 2 × 8, preset fast,
32 stages, 160 lines. Per scene: the true RMS error and its estimate in percent of full scale, whether the
stated interval holds the true error, the rank correlation of estimated and true error over 8 × 8 regions and
over frames, and the estimate's share of the processor time. At the end: the share of intervals that held.

--fit calibrates: on the scenes of `acquire.sim.procedural` and the others of `tools.error_scenes`, some of
them also interrupted after a few iterations, it prints the exponents for `acquire/recon/error.py`, for videos
that are judged by their lines and by their prior, and the errors of the estimates when each scene is
predicted from the others. All scenes have equal weight, whatever their number of cases; cases with light
beyond the band are left out.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.stats import spearmanr

from acquire.cores import limit_threads
from acquire.recon import error as estimation
from acquire.recon import reconstruct
from acquire.recon.error import Exponents, Indicators, VideoError, error_from, in_regions
from acquire.sim import procedural
from acquire.sim.procedural import CameraNoise, Recorded
from tools import error_scenes
from tools.results import Run, add_option, recorded

STAGES, SUBSTEPS, LINES = 32, 3, 160
CAMERAS = {"1e4": CameraNoise(), "1e3": CameraNoise(1e3), "clean": procedural.CLEAN}
VOXELS = ((3, 1), (2, 8))
Make = Callable[..., Recorded]
RIDGE = 0.02
"""Share of the number of cases: the penalty that pulls unimportant exponents towards 0."""
FAR, ROUNDS = 0.3, 30
"""Logarithm of an error beyond which a case counts for less (Huber), and number of fits until the weights
have settled. A flash before a clean still is off by five times and would distort all others."""
CUT = ("leds", "leds_dot", "digits", "flicker")
CUT_CAMERAS, CUTS = ("1e4", "clean"), (60, 140, 300)
"""Scenes, the slowest to converge, that the fit also interrupts after these iterations, in 3 × 1 voxels."""
BEYOND_THE_BAND = "fastled"
"""Light that no video of the fit resolves: no estimate is fitted to it, even if that light is not found."""
NINE_OF_TEN = (0.05, 0.95)


@dataclass(frozen=True, eq=False)
class Case:
    """``true`` are RMS errors (time, 8, 8) of the trusted frames, as the indicators are in ``shown``."""

    name: str
    scene: str
    true: np.ndarray
    error: VideoError | str
    shown: slice
    share: float

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.square(self.true).mean()))

    @property
    def regions(self) -> np.ndarray:
        return np.asarray(np.sqrt(np.square(self.true).mean(0)).ravel())

    @property
    def frames(self) -> np.ndarray:
        return np.asarray(np.sqrt(np.square(self.true).mean((1, 2))))


def measure(
    scene: str, seed: int, camera: str, voxels: tuple[int, int], make: Make, iterations: int | None = None
) -> Case:
    """Reconstruct with preset fast, or interrupt preset best after ``iterations``."""
    made = make(scene, seed, stages=STAGES, substeps=SUBSTEPS, lines=LINES, camera=CAMERAS[camera])
    result = reconstruct(
        made.segment, *voxels, "fast" if iterations is None else "best", iterations=iterations
    )
    off = result.video[result.trusted] - made.truth(*voxels)
    took = 0.0 if isinstance(result.error, str) else result.error.processor_s / result.processor_s
    name = f"{scene}, {camera}, {voxels[0]} × {voxels[1]}" + (f", {iterations}" if iterations else "")
    return Case(
        name=name,
        scene=scene,
        true=np.sqrt(in_regions(np.square(off))),
        error=result.error,
        shown=result.trusted,
        share=took,
    )


def show(case: Case, run: Run) -> tuple[bool, np.ndarray, np.ndarray] | None:
    """Print a row; return whether the interval of the whole held, and those of each region and frame."""
    error = case.error
    if isinstance(error, str):
        print(f"{case.name:30} unknown: {error}", flush=True)
        run.add(case.name, true_rms=case.rms, reason=error)
        return None
    regions = np.sqrt(np.square(error.regions[case.shown]).mean(0)).ravel()
    frames = error.frames[case.shown]
    held = error.low <= case.rms <= error.high
    alike = [correlation(*pair) for pair in ((regions, case.regions), (frames, case.frames))]
    percent = 100 / error.full_scale
    print(
        f"{case.name:30} {percent * case.rms:6.2f} %  {percent * error.rms:6.2f}"
        f" ({percent * error.low:.2g} to {percent * error.high:.2g})  {'held' if held else 'MISSED':6}"
        f"  {alike[0]:5.2f}  {alike[1]:5.2f}  {case.share:5.1%}",
        flush=True,
    )
    run.add(
        case.name,
        true_percent=percent * case.rms,
        estimated_percent=percent * error.rms,
        low_percent=percent * error.low,
        high_percent=percent * error.high,
        held=int(held),
        rank_of_regions=alike[0],
        rank_of_frames=alike[1],
        share_of_processor_percent=100 * case.share,
    )
    within = [
        (low * each <= true) & (true <= high * each)
        for each, true, (low, high) in (
            (regions, case.regions, error.region_factors),
            (frames, case.frames, error.frame_factors),
        )
    ]
    return held, within[0], within[1]


def correlation(estimated: np.ndarray, true: np.ndarray) -> float:
    """Rank correlation; NaN if all values are equal, as for the frames of a still."""
    if np.ptp(estimated) == 0 or np.ptp(true) == 0:
        return math.nan
    return float(spearmanr(estimated, true)[0])


def judge(cases: Iterable[Case], run: Run) -> None:
    print(f"{'':30}  true     estimate (nine of ten)          regions frames  of the time")
    shown = [found for found in (show(case, run) for case in cases) if found is not None]
    if not shown:
        return
    held, regions, frames = (
        float(np.mean(np.concatenate([np.ravel(each[k]) for each in shown]))) for k in range(3)
    )
    print(f"{len(shown)} estimated: held {held:.0%}, regions {regions:.0%}, frames {frames:.0%}")
    run.add(
        "all that are estimated",
        held_percent=100 * held,
        regions_held_percent=100 * regions,
        frames_held_percent=100 * frames,
    )


def signs(indicators: Indicators, shown: slice) -> np.ndarray:
    """Logarithms of the whole video's predictors, whose exponents are `Exponents.whole`."""
    return estimation.log_indicators(
        float(np.sqrt(np.square(indicators.sensitivity[shown]).mean())), indicators
    )


def signs_here(indicators: Indicators, shown: slice) -> np.ndarray:
    """Logarithms of the regions' predictors relative to the whole (64, 3)."""
    maps = (np.sqrt(np.square(indicators.sensitivity[shown]).mean(0)), indicators.change, indicators.edge)
    return np.stack([np.log(each / np.sqrt(np.square(each).mean())).ravel() for each in maps], 1)


def robust(rows: list[np.ndarray], wanted: list[np.ndarray], scenes: list[str]) -> np.ndarray:
    """Fit exponents, penalised towards 0 except the constant; one item per case, equal weight per scene."""
    share = np.repeat(_shares(scenes), [len(each) for each in wanted]) / np.repeat(
        [len(each) for each in wanted], [len(each) for each in wanted]
    )
    every, right = np.concatenate(rows), np.concatenate(wanted)
    held = np.ones(every.shape[1])
    held[0] = 0 if np.all(every[:, 0] == 1) else 1
    weight = share
    for _ in range(ROUNDS):
        lighter = every.T * weight
        powers = np.linalg.solve(lighter @ every + RIDGE * weight.sum() * np.diag(held), lighter @ right)
        weight = share * np.minimum(1, FAR / np.maximum(abs(right - every @ powers), 1e-9))
    return np.asarray(powers)


def _shares(scenes: list[str]) -> np.ndarray:
    """Weight of each case, such that all scenes count equally."""
    _, place, count = np.unique(scenes, return_inverse=True, return_counts=True)
    return np.asarray(1 / count[place])


def fit(cases: list[Case]) -> Exponents:
    """Fit the exponents in use; keep the factors, which come from scenes left out of the fit."""
    estimated = [(case, case.error.indicators) for case in cases if isinstance(case.error, VideoError)]
    scenes = [case.scene for case, _ in estimated]
    known = estimated[0][1].exponents
    there = known.whole != 0
    whole = np.zeros(len(there))
    whole[there] = robust(
        [signs(indicators, case.shown)[None, there] for case, indicators in estimated],
        [np.log([case.rms / indicators.residual]) for case, indicators in estimated],
        scenes,
    )
    true = [
        np.maximum(case.regions, indicators.exponents.floor * indicators.scale)
        for case, indicators in estimated
    ]
    here = robust(
        [signs_here(indicators, case.shown) for case, indicators in estimated],
        [np.log(each / np.sqrt(np.square(each).mean())) for each in true],
        scenes,
    )
    moved = [
        np.sqrt(np.square(indicators.sensitivity[case.shown]).mean((1, 2))) for case, indicators in estimated
    ]
    now = robust(
        [np.log(each / np.sqrt(np.square(each).mean()))[:, None] for each in moved],
        [np.log(case.frames / case.rms) for case, _ in estimated],
        scenes,
    )
    names = [each.name for each in fields(Exponents) if each.type == "float" and each.name != "floor"]
    powers = dict(zip(names, np.concatenate([whole, here, now]).tolist(), strict=True))
    return replace(known, **powers)


def nine_of_ten(off: list[np.ndarray], scenes: list[str]) -> tuple[float, float]:
    """Limits between which nine of ten values lie, with equal weight for each scene."""
    share = np.repeat(_shares(scenes) / [len(each) for each in off], [len(each) for each in off])
    values = np.concatenate(off)
    order = np.argsort(values)
    below = np.cumsum(share[order]) / share.sum()
    low, high = values[order][np.searchsorted(below, NINE_OF_TEN)]
    return float(low), float(high)


def calibrate(cases: list[Case], name: str, known: Exponents) -> None:
    """Print the exponents, and the factors between true error and estimate on scenes left out of the fit."""
    estimated = [
        case
        for case in cases
        if isinstance(case.error, VideoError)
        and case.error.indicators.exponents is known
        and case.scene != BEYOND_THE_BAND
    ]
    print(f"{name}: {len(estimated)} cases")
    scenes = [case.scene for case in estimated]
    others = {
        scene: fit([case for case in estimated if case.scene != scene]) for scene in sorted(set(scenes))
    }
    wholes, here, now, alike = [], [], [], []
    for case in estimated:
        assert isinstance(case.error, VideoError)
        found = error_from(case.error.indicators, case.shown, others[case.scene])
        regions = np.sqrt(np.square(found.regions[case.shown]).mean(0)).ravel()
        wholes.append(np.array([case.rms / found.rms]))
        here.append(np.maximum(case.regions, known.floor * case.error.full_scale) / regions)
        now.append(case.frames / found.frames[case.shown])
        alike.append(correlation(regions, case.regions))
    for scene in others:
        off = [float(each[0]) for each, of in zip(wholes, scenes, strict=True) if of == scene]
        print(f"{scene:10} {len(off):3} cases, true over estimated: {min(off):.2f} to {max(off):.2f}")
    print(
        f"rank correlation over regions: median {np.nanmedian(alike):.2f},"
        f" a tenth below {np.nanquantile(alike, 0.1):.2f}"
    )
    factors = [nine_of_ten(off, scenes) for off in (wholes, here, now)]
    powers = fit(estimated)
    print(
        f"{name} =", replace(powers, factors=factors[0], region_factors=factors[1], frame_factors=factors[2])
    )


def ways(scene: str, camera: str, *, cut: bool) -> list[tuple[tuple[int, int], int | None]]:
    """Voxels and number of iterations of a scene's cases; None: the preset's."""
    found: list[tuple[tuple[int, int], int | None]] = [(voxels, None) for voxels in VOXELS]
    if cut and scene in CUT and camera in CUT_CAMERAS:
        found += [(VOXELS[0], iterations) for iterations in CUTS]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fit", action="store_true", help="calibrate instead")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--seeds", nargs="+", type=int, metavar="SEED")
    parser.add_argument("--cameras", nargs="+", default=list(CAMERAS), choices=list(CAMERAS))
    add_option(parser)
    options = parser.parse_args()
    drawn: list[tuple[str, Make, Sequence[int]]]
    if options.fit:
        drawn = [(name, procedural.record, options.seeds or (311, 312)) for name in procedural.SCENES]
        drawn += [(name, error_scenes.record, options.seeds or (41,)) for name in error_scenes.SCENES]
    else:
        names = options.scenes or error_scenes.KEPT
        drawn = [(name, error_scenes.record, options.seeds or (901,)) for name in names]
    with limit_threads(1), recorded("bench_error", keep=options.record and not options.fit) as run:
        cases = (
            measure(name, seed, camera, voxels, make, iterations)
            for name, make, seeds in drawn
            for seed in seeds
            for camera in options.cameras
            for voxels, iterations in ways(name, camera, cut=options.fit)
        )
        if options.fit:
            measured = list(cases)
            for name in ("BY_LINES", "BY_PRIOR"):
                calibrate(measured, name, getattr(estimation, name))
        else:
            judge(cases, run)


if __name__ == "__main__":
    main()
