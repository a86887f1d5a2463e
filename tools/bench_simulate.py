"""Rate of the streaming simulation, compared with real time, bare operators, memory and scipy.

    python tools/bench_simulate.py [--stages 64] [--substeps 3] [--seconds 2] [--record]

1. LEDs (separable), one thread: a scene without effects compared with its bare operator (alternating), and
   the operator with its matrix product, on the same windows and weights.
2. Any scene, frame by frame, a thread per arm: frames are ready in memory, more than fit into the caches;
   compared with the time to read as many bytes, and with the same sums as scipy.sparse products (one thread).
3. The additional cost of single effects in case 1.
"""

from __future__ import annotations

import argparse
import itertools
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from acquire.codes import PrbsCode
from acquire.config import GeometryConfig, load_scene
from acquire.config.device import CameraConfig
from acquire.config.scene import SceneFile
from acquire.cores import limit_blas
from acquire.lines import ARMS
from acquire.sim.lines import SeparableLines, StreamingArm
from acquire.sim.pipeline import Bench, Converter
from acquire.sim.scenes import build_scene
from tools.results import Run, add_option, recorded

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

LINE_RATE_HZ = 100e3 / 3
BLOCK_LINES = 4096
DENSE_LINES = 512
POOL_FRAMES = 1024
CODE = PrbsCode.from_seed(64, 1)


def best_s(seconds: float, *works: Callable[[], object]) -> list[float]:
    """Best times of tasks that alternate for ``seconds``: other load can only slow them down."""
    best, end = [float("inf")] * len(works), time.perf_counter() + seconds * len(works)
    while time.perf_counter() < end:
        for k, work in enumerate(works):
            before = time.perf_counter()
            work()
            best[k] = min(best[k], time.perf_counter() - before)
    return best


class Ready:
    """A scene whose frames are in memory, in the order in which lit sub-steps need them."""

    def __init__(self, frames: NDArray[np.float32]) -> None:
        self._frames, self._next = frames, 0
        self.size = frames.shape[1]

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        begin = self._next if self._next + len(substeps) <= len(self._frames) else 0
        self._next = begin + len(substeps)
        return self._frames[begin : self._next]


def separable(bench: Bench, seconds: float, run: Run) -> None:
    M, S = bench.geometry.stages, bench.geometry.substeps
    scene, convert = (
        build_scene(bench.scene, M * S, bench.substep_s),
        Converter.of(bench.cameras["a"]).convert,
    )
    for arm in ARMS:
        bare, piped = StreamingArm(scene, CODE, M, S, arm), bench.camera(arm, CODE)
        firsts = [itertools.count(0, BLOCK_LINES) for _ in range(2)]
        product = bare._lines
        assert isinstance(product, SeparableLines)
        multiply = partial(np.matmul, product._windows, product._weights, out=product._tile.copy())
        times = best_s(
            seconds,
            lambda bare=bare, first=firsts[0]: convert(bare.lines(next(first), BLOCK_LINES)),
            lambda piped=piped, first=firsts[1]: piped.read(next(first), BLOCK_LINES),
            multiply,
        )
        rates = [BLOCK_LINES / times[0], BLOCK_LINES / times[1], len(product._windows) / times[2]]
        print(
            f"LEDs, arm {arm}: pipeline without effects {rates[1]:9.0f} lines/s = "
            f"{rates[1] / LINE_RATE_HZ:5.1f} x 33.33 kHz; "
            f"bare operator {rates[0]:9.0f} (ratio {times[1] / times[0]:.3f}); "
            f"of the bare product {rates[1] / rates[2]:.2f}"
        )
        run.add(
            f"LEDs, arm {arm}, lines",
            times_real_time=rates[1] / LINE_RATE_HZ,
            lines_per_s=rates[1],
            bare_operator_lines_per_s=rates[0],
            of_the_bare_product=rates[1] / rates[2],
        )


def dense(M: int, S: int, seconds: float, run: Run) -> None:
    n = M * S
    pool = np.random.default_rng(0).random((POOL_FRAMES, n, n), np.float32)
    arms = [StreamingArm(Ready(pool), CODE, M, S, arm) for arm in ARMS]
    firsts = [itertools.count(0, DENSE_LINES) for _ in ARMS]
    lit = CODE.bits(0, S * DENSE_LINES * 8).mean() * S * DENSE_LINES
    with ThreadPoolExecutor(2) as threads:

        def both() -> None:
            list(threads.map(lambda arm, first: arm.lines(next(first), DENSE_LINES), arms, firsts))

        def read() -> None:
            list(threads.map(np.sum, (pool, pool)))

        lines_s, read_s = best_s(seconds, both, read)
    rate, bound = DENSE_LINES / lines_s, DENSE_LINES / (read_s * lit / POOL_FRAMES)
    print(
        f"frames, both arms on two threads: {rate:9.0f} lines/s = {rate / LINE_RATE_HZ:5.2f} x 33.33 kHz; "
        f"reading their {2 * lit * 4e-6 * n**2:.0f} MB allows {bound:.0f} "
        f"({2 * pool.nbytes / read_s * 1e-9:.1f} GB/s): {rate / bound:.2f} of it"
    )
    run.add(
        "frames, both arms on two threads",
        times_real_time=rate / LINE_RATE_HZ,
        lines_per_s=rate,
        reading_them_gb_s=2 * pool.nbytes / read_s * 1e-9,
        of_what_reading_allows=rate / bound,
    )
    block = pool[: min(POOL_FRAMES, 256)]
    matrix = packets_matrix(len(block), n)
    arm = StreamingArm(Ready(block), CODE, M, S, "a")
    first = itertools.count(0, DENSE_LINES)
    one_s, a_s, b_s = best_s(
        seconds,
        lambda: arm.lines(next(first), DENSE_LINES),
        lambda: matrix @ block.reshape(-1, n),
        lambda: matrix @ block.transpose(0, 2, 1).reshape(-1, n),
    )
    per_frame = one_s / lit
    print(
        f"one arm, one thread: {per_frame * 1e6:.1f} us per lit frame; "
        f"scipy.sparse {a_s / len(block) * 1e6:.1f} us (arm a), {b_s / len(block) * 1e6:.1f} us (arm b): "
        f"{a_s / len(block) / per_frame:.1f} and {b_s / len(block) / per_frame:.1f} times as long"
    )
    run.add(
        "a lit frame, one arm, one thread",
        us=per_frame * 1e6,
        scipy_sparse_a_us=a_s / len(block) * 1e6,
        scipy_sparse_b_us=b_s / len(block) * 1e6,
    )


def packets_matrix(frames: int, n: int) -> sparse.csr_array:
    """(packet, frame · row): packet q sums row t − q of frame t, all frames lit."""
    t, r = np.divmod(np.arange(frames * n), n)
    ones = np.ones(frames * n, np.float32)
    return sparse.coo_array((ones, (t - r + n - 1, np.arange(frames * n)))).tocsr()


def effects(bench: Bench, seconds: float, run: Run) -> None:
    listed = load_scene("scene-leds-measured").effects
    for effect in listed:
        scene = SceneFile.model_validate(
            bench.scene.model_dump(mode="json") | {"effects": [effect.model_dump(mode="json")]}
        ).root
        one = Bench(scene, bench.geometry, bench.cameras, bench.substep_s)
        cameras = bench.camera("b", CODE), one.camera("b", CODE)
        firsts = [itertools.count(0, BLOCK_LINES) for _ in cameras]
        works = [
            partial(lambda c, f: c.read(next(f), BLOCK_LINES), c, f)
            for c, f in zip(cameras, firsts, strict=True)
        ]
        without, with_it = best_s(seconds / 4, *works)
        added_us = (with_it - without) / BLOCK_LINES * 1e6
        print(f"{effect.kind:18} {added_us:+7.3f} us per line and arm")
        run.add(f"effect {effect.kind}, added per line and arm", us=added_us)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--stages", type=int, default=64)
    parser.add_argument("--substeps", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0)
    add_option(parser)
    options = parser.parse_args()
    libraries = limit_blas(1).get_original_num_threads()
    print(f"M = {options.stages}, S = {options.substeps}; libraries limited to one thread: {len(libraries)}")
    camera = CameraConfig(responsivity_dn=6.0)
    geometry = GeometryConfig(stages=options.stages, substeps=options.substeps)
    bench = Bench(load_scene("scene-leds"), geometry, {"a": camera, "b": camera}, 1e-5)
    with recorded("bench_simulate", keep=options.record) as run:
        separable(bench, options.seconds, run)
        dense(options.stages, options.substeps, options.seconds, run)
        effects(bench, options.seconds, run)


if __name__ == "__main__":
    main()
