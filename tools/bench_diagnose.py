"""Are wrong descriptions named, and right ones accepted? Procedural scenes with an ordinary camera's noise.

Usage: python tools/bench_diagnose.py [--seeds 11 12] [--scenes bullet …] [--full-well 10000]

Every scene is recorded once per seed (of scene, code and noise), described correctly and incorrectly, and
diagnosed. `acquire.recon.search` was developed on seeds 1 to 5, so figures of other seeds count separately.
Prints the answer for each: ✓ named correctly, ? undecided, · nothing, u the code does not explain the lines,
2 one of two, ✗ another fault; ! a level in addition. For a right description any fault named is a false
alarm.

    seed      the code of another seed         swapped   arm A is called B
    inverted  every bit                        mirrored  arm B's pixels in the other order
    substep   one sub-step late or early       geometry  S = 2 or 4 in place of 3
    line      one line late or early
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from acquire.codes import mix_seed, prbs
from acquire.cores import limit_threads
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon.diagnosis import Diagnosis, diagnose
from acquire.recon.hypotheses import Hypothesis, Turn
from acquire.recon.search import Standing
from acquire.sim.procedural import SCENES, CameraNoise, record
from tools.results import Run, add_option, recorded

DEGREE, AHEAD = 31, 64
"""Recordings begin a few bits into their code, so that the code can be early as well as late."""


def shifted(segment: Segment, bits: np.ndarray, late: int) -> Segment:
    """Describe the segment with a code against which its lines are ``late`` sub-steps late."""
    return replace(segment, code=bits[AHEAD + late : AHEAD + late + segment.geometry.span])


def described_as(segment: Segment, bits: np.ndarray, substeps: int) -> Segment:
    geometry = Geometry(segment.geometry.stages, substeps, segment.geometry.lines)
    return replace(segment, geometry=geometry, code=bits[AHEAD : AHEAD + geometry.span])


def faults(segment: Segment, bits: np.ndarray, seed: int) -> dict[str, tuple[Segment, Hypothesis | None]]:
    """Wrong descriptions, each with the hypothesis that corrects it; None: no hypothesis does."""
    sign, S = 1 - 2 * (seed % 2), segment.geometry.substeps
    a, b = segment.lines
    other = prbs(DEGREE, mix_seed(seed + 4711, DEGREE), 0, segment.geometry.span)
    return {
        "right": (segment, Hypothesis()),
        "seed": (replace(segment, code=other), None),
        "inverted": (replace(segment, code=1 - segment.code), Hypothesis(inverted=True)),
        "substep": (shifted(segment, bits, sign), Hypothesis(late=(sign, sign))),
        "line": (shifted(segment, bits, sign * S), Hypothesis(late=(sign * S, sign * S))),
        "swapped": (
            replace(segment, lines=np.stack([b, a]), mask=segment.mask[::-1]),
            Hypothesis(turn=Turn(rows=True, pixels=True)),
        ),
        "mirrored": (
            replace(
                segment,
                lines=np.stack([a, b[:, ::-1]]),
                mask=np.stack([segment.mask[0], segment.mask[1, :, ::-1]]),
            ),
            Hypothesis(turn=Turn(pixels=True)),
        ),
        "geometry": (described_as(segment, bits, S + sign), Hypothesis(substeps=S)),
    }


def mark(found: Diagnosis, truth: Hypothesis | None) -> str:
    if truth == Hypothesis():
        return {Standing.RIGHT: "✓", Standing.UNCLEAR: "?"}.get(found.standing, "✗")
    if found.standing in (Standing.RIGHT, Standing.UNCLEAR):
        return "?" if found.standing is Standing.UNCLEAR else "·"
    if found.standing is Standing.UNEXPLAINED:
        return "✓" if truth is None else "u"
    if truth is not None and found.alternative is not None and truth in (found.hypothesis, found.alternative):
        return "2"
    return "✓" if found.hypothesis == truth else "✗"


def segment_of(name: str, seed: int, camera: CameraNoise) -> tuple[Segment, np.ndarray]:
    """A segment, and the code's bits from `AHEAD` before it on."""
    segment = record(name, seed, camera=camera).segment
    later = prbs(DEGREE, mix_seed(seed, DEGREE), 0, 2 * segment.geometry.span)
    before = np.random.default_rng(seed).integers(0, 2, AHEAD).astype(np.uint8)
    assert (later[: segment.geometry.span] == segment.code).all()
    return segment, np.concatenate([before, later])


def table(
    scenes: list[str], seeds: list[int], camera: CameraNoise, say: Callable[[str], object], run: Run
) -> None:
    total: dict[str, list[str]] = {}
    seconds = []
    for seed in seeds:
        for name in scenes:
            segment, bits = segment_of(name, seed, camera)
            row = []
            for fault, (described, truth) in faults(segment, bits, seed).items():
                began = time.process_time()
                found = diagnose(described)
                seconds.append(time.process_time() - began)
                row.append(mark(found, truth))
                total.setdefault(fault, []).append(row[-1])
                if fault == "right" and found.suspicions:
                    row[-1] += "!"
            if name == scenes[0]:
                say(f"{'seed ' + str(seed):12s}" + "".join(f"{fault:>10s}" for fault in total))
            say(f"{name:12s}" + "".join(f"{each:>10s}" for each in row))
    wrong = [each for fault, marks in total.items() if fault != "right" for each in marks]
    say("")
    say(f"{'named':12s}" + "".join(f"{m.count('✓'):>6d}/{len(m):<3d}" for m in total.values()))
    false_alarms = sum(m not in "✓?" for m in total["right"])
    for fault, marks in total.items():
        run.add(fault, named=marks.count("✓"), misnamed=marks.count("✗"), cases=len(marks))
    run.add(
        "all",
        wrong_named=wrong.count("✓"),
        wrong_misnamed=wrong.count("✗"),
        wrong_cases=len(wrong),
        false_alarms=false_alarms,
        right_cases=len(total["right"]),
        median_cpu_s=np.median(seconds),
        worst_cpu_s=max(seconds),
    )
    say(
        f"wrong descriptions named: {wrong.count('✓')} of {len(wrong)}, misnamed {wrong.count('✗')}; "
        f"false alarms {false_alarms} of {len(total['right'])}; "
        f"processor seconds: median {np.median(seconds):.1f}, most {max(seconds):.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[11])
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--full-well", type=float, default=1e4, help="electrons of the brightest sample")
    add_option(parser)
    options = parser.parse_args()
    camera = CameraNoise(full_well_e=options.full_well)
    with limit_threads(1), recorded("bench_diagnose", keep=options.record) as run:
        table(options.scenes, options.seeds, camera, lambda line: print(line, flush=True), run)


if __name__ == "__main__":
    main()
