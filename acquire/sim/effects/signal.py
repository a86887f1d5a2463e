"""Effects on expected lines: the amount of light, and the transfer of its charge."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.sim.effects.base import TILE_LINES, Effect, Place, Setting, Stage

if TYPE_CHECKING:
    from numpy.typing import NDArray


_TAIL = 1e-9
"""Fraction of the charge that may be neglected."""


class BeamSplitter(Effect):
    """Arm A gets ``part_a`` of the light, arm B the rest; the responsivity is stated for 0.5."""

    kind: Literal["beam_splitter"]
    place: ClassVar[Place] = "signal"
    rank: ClassVar[float] = 10
    part_a: float = Field(gt=0, lt=1)

    def stages(self, setting: Setting) -> list[Stage]:
        """Y_A ← 2p·Y_A, Y_B ← 2(1 − p)·Y_B: the responsivities are stated for a 50:50 splitter."""
        part = self.part_a if setting.arm == "a" else 1 - self.part_a

        def run(lines: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            return lines * (2 * part)

        return [Stage("beam_splitter", "signal", run)]


class ChargeTransfer(Effect):
    """Charge transfer inefficiency: every transfer leaves part of the charge to the next line."""

    kind: Literal["cti"]
    place: ClassVar[Place] = "signal"
    rank: ClassVar[float] = 20
    inefficiency: float = Field(gt=0, le=0.01, description="fraction left behind per sub-step's transfer")

    def stages(self, setting: Setting) -> list[Stage]:
        """Y(ℓ) ← Σ_k p_k·Y(ℓ − k): every transfer leaves the fraction ε of the charge to the next line.

        After N transfers, k of them have failed with negative binomial probability
        p_k(N) = C(N + k − 1, k)·(1 − ε)^N·ε^k. Charge collected evenly over the n rows has made N = 1 … n
        transfers, and p_k is the mean over these (Janesick, Scientific CCDs, ch. 5). The charge left behind
        is a random part of Poisson electrons and hence Poisson again, so only the expected lines change.
        """
        weights = tail(self.inefficiency, setting.stages * setting.substeps)
        lead = len(weights) - 1

        def run(lines: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            transferred: NDArray[Any] = weights[0] * lines[lead:]
            for k in range(1, len(weights)):
                transferred += weights[k] * lines[lead - k : len(lines) - k]
            return transferred

        return [Stage("cti", "signal", run, lead=lead)]


def tail(inefficiency: float, transfers: int) -> NDArray[np.float64]:
    """Return p_k, the mean over 1 … ``transfers`` transfers, up to all but 1e-9 of the charge."""
    count = np.arange(1, transfers + 1, dtype=np.float64)
    term = (1 - inefficiency) ** count
    weights = [term.mean()]
    # Fewer than a tile of lines, which is the history that an image keeps (`pipeline`).
    while 1 - sum(weights) > _TAIL and len(weights) < TILE_LINES:
        k = len(weights)
        # C(N + k − 1, k) is C(N + k − 2, k − 1)·(N + k − 1)/k.
        term = term * (count + k - 1) / k * inefficiency
        weights.append(term.mean())
    return np.array(weights)
