"""Cost of the sensing matrix: matrix-free, with scipy.sparse, and compared with a copy of the voxels.

Usage: python tools/bench_operator.py [--record]

For the sizes of the paper's figures: one forward and one adjoint of both arms, the same with an explicit
sparse matrix, and a copy of the voxels, the lower limit for any operation on all of them. Best of five each.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy import sparse

from acquire.codes import mix_seed, prbs
from acquire.forward import DualArm
from acquire.geometry import Geometry
from tools.results import add_option, best_ms, recorded

CASES = {
    "Fig. 9, 64 × 64 × 980": (64, 263, 3, 1),
    "Fig. 7 motion, 54 × 54 × 1025": (54, 1313, 3, 4),
    "Fig. 7 detail, 162 × 162 × 5": (54, 1313, 1, 820),
    "Fig. 6 static, 192 × 192": (64, 263, 1, 980),
}


def explicit(geometry: Geometry, code: np.ndarray, N_m: int, T_m: int) -> sparse.csr_array:
    """Λ′ (2·L_R·M, voxels) of Eq. (1), entry by entry, duplicates summed."""
    frames, side, _ = geometry.video_shape(N_m, T_m)
    M, S, n = geometry.stages, geometry.substeps, geometry.size
    i, u, r, c = np.meshgrid(
        np.arange(geometry.lines), np.arange(S), np.arange(n), np.arange(n), indexing="ij"
    )
    t = (r + u + i * S).ravel()
    lit = code[t] == 1
    row = (i.ravel() * M + c.ravel() // S)[lit]
    t, along, across = t[lit] // T_m, r.ravel()[lit], c.ravel()[lit] // N_m
    arms = (
        (t * side + along // N_m) * side + across,
        (t * side + across) * side + (n - 1 - along) // N_m,
    )
    shape = (geometry.lines * M, frames * side * side)
    ones = np.ones(len(row), np.float32)
    return sparse.vstack(
        [sparse.coo_array((ones, (row, voxel)), shape=shape).tocsr() for voxel in arms]
    ).tocsr()


FIGURES = ("forward_ms", "adjoint_ms", "sparse_ms", "sparse_transposed_ms", "copy_ms")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_option(parser)
    with recorded("bench_operator", keep=parser.parse_args().record) as run:
        print(f"{'case':32}{'forward':>10}{'adjoint':>10}{'sparse':>10}{'sparse T':>10}{'copy':>8}   ms")
        for name, case in CASES.items():
            figures = measure(*case)
            print(f"{name:32}" + "".join(f"{figure:10.2f}" for figure in figures[:4]) + f"{figures[4]:8.2f}")
            run.add(name, **dict(zip(FIGURES, figures, strict=True)))


def measure(M: int, L_R: int, N_m: int, T_m: int) -> list[float]:
    """Milliseconds of forward, adjoint, sparse forward, sparse adjoint, and a copy of the voxels."""
    geometry = Geometry(M, 3, L_R)
    code = prbs(64, mix_seed(1, 64), 0, geometry.span)
    op = DualArm(geometry, code, N_m, T_m)
    x = np.random.default_rng(0).random(op.video_shape, np.float32)
    y = op.forward(x)
    matrix = explicit(geometry, code, N_m, T_m)
    transposed = matrix.T.tocsr()
    assert np.allclose(matrix @ x.ravel(), y.ravel(), rtol=1e-3, atol=1e-2)
    return [
        best_ms(lambda: op.forward(x)),
        best_ms(lambda: op.adjoint(y)),
        best_ms(lambda: matrix @ x.ravel()),
        best_ms(lambda: transposed @ y.ravel()),
        best_ms(x.copy),
    ]


if __name__ == "__main__":
    main()
