"""Speed of our TV proximal step compared with a library's, on the coefficient frames of the demo.

Usage: python tools/bench_tv.py [--frames 128] [--side 64] [--iterations 10] [--record]

Both make the same number of iterations of gradient projection on the same frames with two threads (ours)
and one (scikit-image has no more). Prints milliseconds and the ratio, the best of five each.
"""

from __future__ import annotations

import argparse

import numpy as np
from skimage.restoration import denoise_tv_chambolle

from acquire.recon.tv import FrameTv
from tools.results import Run, add_option, best_ms, recorded


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in (("frames", 128), ("side", 64), ("iterations", 10)):
        parser.add_argument(f"--{name}", type=int, default=default)
    add_option(parser)
    options = parser.parse_args()
    with recorded("bench_tv", keep=options.record) as run:
        measure(run, options)


def measure(run: Run, options: argparse.Namespace) -> None:
    shape = (options.frames, options.side, options.side)
    frames = np.random.default_rng(0).random(shape, np.float32)
    tv = FrameTv(options.iterations)
    ours = best_ms(lambda: tv.prox(frames, 0.1))

    def library() -> None:
        for frame in frames:
            denoise_tv_chambolle(frame, weight=0.1, eps=0.0, max_num_iter=options.iterations)

    theirs = best_ms(library)
    case = f"{options.frames} frames of {options.side}², {options.iterations} iterations"
    run.add(case, acquire_ms=ours, scikit_image_ms=theirs, ratio=theirs / ours)
    print(case)
    print(f"acquire       {ours:8.1f} ms")
    print(f"scikit-image  {theirs:8.1f} ms   {theirs / ours:.1f} × ours")


if __name__ == "__main__":
    main()
