"""Test a linear map against its transpose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Map = Callable[[NDArray[Any]], NDArray[Any]]


def assert_adjoint(
    forward: Map, adjoint: Map, shape: tuple[int, ...], *, seed: int = 0, rtol: float = 1e-9
) -> None:
    """Assert ⟨A·x, y⟩ = ⟨x, Aᵀ·y⟩ for random x of ``shape`` and random y of the shape of A·x, in float64.

    ``rtol`` is relative to ‖A·x‖·‖y‖, which cannot become small by cancellation; float32 needs about 1e-5.
    """
    draws = np.random.default_rng(seed)
    x = draws.standard_normal(shape)
    image = forward(x)
    y = draws.standard_normal(image.shape)
    back = adjoint(y)
    assert back.shape == x.shape, f"the transpose returns shape {back.shape} for an x of shape {x.shape}"
    gap = abs(float(np.vdot(image, y)) - float(np.vdot(x, back)))
    scale = float(np.linalg.norm(image) * np.linalg.norm(y))
    # Of zeros, anything would pass as the transpose.
    assert scale > 0, "the map returns only zeros"
    assert gap <= rtol * scale, f"⟨A·x, y⟩ and ⟨x, Aᵀ·y⟩ differ by {gap / scale:.2g} of ‖A·x‖·‖y‖"
