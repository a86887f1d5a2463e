"""Effects on expected lines: how much light, and where its charge ends up."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.sim.effects.base import Effect, Place, Setting, Stage

if TYPE_CHECKING:
    from numpy.typing import NDArray


_TAIL = 1e-9
"""Part of the charge that may be forgotten."""


class BeamSplitter(Effect):
    """Arm A gets ``part_a`` of the light, arm B the rest; 0.5 is what the responsivity is stated for."""

    kind: Literal["beam_splitter"]
    place: ClassVar[Place] = "signal"
    rank: ClassVar[float] = 10
    part_a: float = Field(gt=0, lt=1)

    def stages(self, setting: Setting) -> list[Stage]:
        """Y_A ← 2p·Y_A, Y_B ← 2(1 − p)·Y_B: a splitter of 50:50 is what the responsivities are stated for."""
        part = self.part_a if setting.arm == "a" else 1 - self.part_a

        def run(lines: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            return lines * (2 * part)

        return [Stage("beam_splitter", "signal", run)]


class ChargeTransfer(Effect):
    """Every transfer leaves a part of the charge behind, to the next line."""

    kind: Literal["cti"]
    place: ClassVar[Place] = "signal"
    rank: ClassVar[float] = 20
    inefficiency: float = Field(gt=0, le=0.01, description="per transfer of a sub-step")

    def stages(self, setting: Setting) -> list[Stage]:
        """Y(ℓ) ← Σ_k p_k·Y(ℓ − k): every transfer leaves the part ε of the charge to the next line.

        After N transfers k of them have failed with negative binomial probability
        p_k(N) = C(N + k − 1, k)·(1 − ε)^N·ε^k; charge that is gathered evenly over the n rows has made
        N = 1 … n transfers, of which p_k is the mean (Janesick, Scientific CCDs, ch. 5). What is left behind
        is a random part of Poisson electrons, hence Poisson again: the expected lines are all that changes.
        """
        weights = tail(self.inefficiency, setting.stages * setting.substeps)
        lead = len(weights) - 1

        def run(lines: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            moved: NDArray[Any] = weights[0] * lines[lead:]
            for k in range(1, len(weights)):
                moved += weights[k] * lines[lead - k : len(lines) - k]
            return moved

        return [Stage("cti", "signal", run, lead=lead)]


def tail(inefficiency: float, transfers: int) -> NDArray[np.float64]:
    """p_k, mean over 1 … ``transfers`` transfers; as many terms as hold all but 1e-9 of the charge."""
    count = np.arange(1, transfers + 1, dtype=np.float64)
    term = (1 - inefficiency) ** count
    weights = [term.mean()]
    while 1 - sum(weights) > _TAIL and len(weights) < 256:
        k = len(weights)
        term = term * (count + k - 1) / k * inefficiency
        weights.append(term.mean())
    return np.array(weights)
