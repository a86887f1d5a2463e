"""What lines reveal of the instrument without a calibration: the arms' balance, light beyond the band.

    python tools/bench_told.py balance [--scenes still splash …] [--seeds 70 71]
    python tools/bench_told.py field
    python tools/bench_told.py fast

balance   dB of a reconstruction (32 stages, voxels 2 × 8) where arm B gets a multiple of the light of arm A,
          without and with the blind balance
field     arms that get the same light but do not see the same field: the error of the balance, and how often
          it is corrected wrongly
fast      a lamp of 20 kHz, and scenes without one: how often light beyond the band is reported

All have the noise of a full well of 10⁴ e, and seeds of scene, code and noise on which nothing was tuned.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from acquire.codes import mix_seed, prbs
from acquire.cores import limit_threads
from acquire.evaluate.metrics import psnr
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon import reconstruct
from acquire.recon.balance import balance_of
from acquire.sim.procedural import BLACK_DN, SCENES, CameraNoise, expose, light, record
from tools.results import Run, add_option, recorded

RATIOS = (1.0, 1.02, 1.05, 1.1, 1.2)
STAGES, LINES = 32, 160
SHIFTS = ((1, -1), (3, -2), (6, -4), (12, -8))
"""Rows and columns, of 96 fine pixels, by which arm B's field is displaced."""
MARGIN = 12
FAST = "fastled"


def split(segment: Segment, ratio: float) -> Segment:
    """The segment as recorded behind a splitter that gives arm B ``ratio`` times the light of arm A."""
    shares = np.array([2 / (1 + ratio), 2 * ratio / (1 + ratio)])[:, None, None]
    pixels = np.clip((segment.lines - BLACK_DN) * shares + BLACK_DN, 0, 4095)
    return replace(segment, lines=np.rint(pixels).astype(np.uint16), mask=pixels < 4095)


def balance(run: Run, scenes: list[str], seeds: list[int]) -> None:
    for scene in scenes:
        for seed in seeds:
            whole = record(scene, seed, stages=STAGES, lines=LINES)
            truth = whole.truth(2, 8)
            for ratio in RATIOS:
                segment, found = split(whole.segment, ratio), {}
                for name, known in (("without", True), ("with", False)):
                    result = reconstruct(replace(segment, balanced=known), 2, 8, "fast", check=False)
                    found[f"{name}_db"] = psnr(result.video[result.trusted], truth)
                facts = result.parameters["balance"]
                run.add(f"{scene}, seed {seed}, {ratio}", **found, **facts)
                print(
                    f"{scene:9} {seed} {ratio:4} {found['without_db']:5.1f} → {found['with_db']:4.1f} dB  "
                    f"{facts['ratio']:.3f} ± {facts['error']:.3f}{' corrected' * facts['corrected']}",
                    flush=True,
                )


def shifted(scene: str, seed: int, rows: int, columns: int) -> Segment:
    """Lines of arms that see the same light, with arm B's field displaced by some fine pixels."""
    geometry = Geometry(STAGES, 3, LINES)
    size, code = geometry.size, prbs(31, mix_seed(seed, 31), 0, geometry.span)
    wide = light(scene, seed, size + MARGIN, geometry.span)
    views = [
        wide[:, row : row + size, column : column + size]
        for row, column in ((max(-rows, 0), max(-columns, 0)), (max(rows, 0), max(columns, 0)))
    ]
    operator = DualArm(geometry, code)
    exact = [operator.forward(np.ascontiguousarray(view))[arm] for arm, view in enumerate(views)]
    return expose(np.stack(exact).astype(np.float64), geometry, code, CameraNoise(), seed)


def field(run: Run, scenes: list[str], seeds: list[int]) -> None:
    for shift in SHIFTS:
        found = {
            f"{scene} {seed}": balance_of([shifted(scene, seed, *shift)])
            for scene in scenes
            for seed in seeds
        }
        off = np.array([each.ratio - 1 for each in found.values() if each is not None])
        wrong = [name for name, each in found.items() if each is not None and each.clear]
        figures = {"rms": float(np.sqrt(np.mean(off**2))), "worst": float(np.abs(off).max())}
        run.add(f"{shift[0]}, {shift[1]} of 96 px", **figures, corrected=len(wrong), cases=len(found))
        print(
            f"{shift} of 96 px: rms {figures['rms']:.3f}, worst {figures['worst']:.3f}; "
            f"corrected {len(wrong)} of {len(found)} {', '.join(wrong)}",
            flush=True,
        )


def fast(run: Run, scenes: list[str], seeds: list[int]) -> None:
    counts = {True: [0, 0], False: [0, 0]}
    for scene in scenes:
        for seed in seeds:
            for stages, lines in ((48, 200), (64, 263)):
                result = reconstruct(record(scene, seed, stages=stages, lines=lines).segment, 3, 1, "fast")
                warnings = [text for text in result.warnings if text.startswith("light changes")]
                run.add(f"{scene}, seed {seed}, {stages} stages", warnings="; ".join(warnings))
                counts[scene == FAST][0] += bool(warnings)
                counts[scene == FAST][1] += 1
                if warnings or scene == FAST:
                    print(
                        f"{scene:9} {seed} {stages} stages: {warnings or 'nothing is reported'}", flush=True
                    )
    for has_lamp, (reported, cases) in counts.items():
        print(f"{'with' if has_lamp else 'without'} the lamp: reported in {reported} of {cases}")


WAYS = {"balance": balance, "field": field, "fast": fast}
SEEDS = {"balance": [70, 71], "field": [601, 602], "fast": [501, 502]}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=list(WAYS))
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES), metavar="SCENE")
    parser.add_argument("--seeds", nargs="+", type=int, help="absent: those of the published tables")
    add_option(parser)
    options = parser.parse_args()
    with limit_threads(1), recorded("bench_told", keep=options.record) as run:
        WAYS[options.what](run, options.scenes, options.seeds or SEEDS[options.what])


if __name__ == "__main__":
    main()
