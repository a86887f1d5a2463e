"""How fast the streaming simulation gives lines, against the built setup's line rate and the bare product.

    python tools/bench_simulate.py [--stages 64] [--substeps 3] [--seconds 2]

One thread. The bare product is the matrix product of one tile, on the same windows and weights, in the same
run: what is left of the ratio is the code, the LEDs, the windows and the copies.
"""

from __future__ import annotations

import argparse
import itertools
import time
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from acquire.codes import PrbsCode, mix_seed
from acquire.config import load_scene
from acquire.lines import ARMS
from acquire.sim.blas import limit_blas_threads
from acquire.sim.lines import SeparableLines, StreamingArm
from acquire.sim.scenes import build_scene

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

LINE_RATE_HZ = 100e3 / 3
BLOCK_LINES = 4096


def lines_per_second(lines: int, work: Callable[[], object], seconds: float) -> float:
    """Best of the calls that fit into ``seconds``: the machine's other work only ever slows one down."""
    best, end = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < end:
        before = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - before)
    return lines / best


def next_lines(stream: StreamingArm, firsts: Iterator[int]) -> None:
    stream.lines(next(firsts), BLOCK_LINES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--stages", type=int, default=64)
    parser.add_argument("--substeps", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0)
    options = parser.parse_args()
    told = limit_blas_threads(1)
    print(f"M = {options.stages}, S = {options.substeps}; libraries limited to one thread: {len(told)}")
    scene = build_scene(load_scene("scene-leds.toml"), options.stages * options.substeps, 1e-5)
    code = PrbsCode(64, mix_seed(1, 64))
    for arm in ARMS:
        stream = StreamingArm(scene, code, options.stages, options.substeps, arm)
        firsts = itertools.count(-options.stages - 1, BLOCK_LINES)
        rate = lines_per_second(BLOCK_LINES, partial(next_lines, stream, firsts), options.seconds)
        product = stream._lines
        assert isinstance(product, SeparableLines)
        windows, weights = product._windows, product._weights
        multiply = partial(np.matmul, windows, weights, out=product._tile)
        bare = lines_per_second(len(windows), multiply, options.seconds / 2)
        print(
            f"arm {arm}: {rate:9.0f} lines/s = {rate / LINE_RATE_HZ:5.1f} x the line rate of 33.33 kHz"
            f" = {rate / bare:4.2f} of the bare product ({bare:.0f}/s, {windows.shape} x {weights.shape})"
        )


if __name__ == "__main__":
    main()
