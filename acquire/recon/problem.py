"""What the solvers work on: samples made dimensionless, with a mask and an operator of norm at most 1.

Dividing by the operator's norm bound and by the scene's mean makes λ mean the same for every segment,
whatever the camera's gain or the light. Samples that are lost, saturated or no light at all (outliers) are
masked: their weight is 0 and their value is never looked at.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from acquire.errors import NumericsError, UsageError
from acquire.forward import DualArm
from acquire.recon.outliers import outliers

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment


class Operator(Protocol):
    """A linear map to lines (2, L_R, M) with its transpose."""

    def forward(self, x: NDArray[Any], /) -> NDArray[Any]: ...

    def adjoint(self, y: NDArray[Any], /) -> NDArray[Any]: ...


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Find x with ``weight·(B·x/norm) ≈ weight·samples``.

    Attributes
    ----------
    samples : (2, L_R, M) dimensionless, 0 where masked
    weight : (2, L_R, M) 1 where the sample counts, else 0
    held_out : (2, L_R, M) bool, samples kept from the solver to judge its prediction
    norm : upper bound of ‖Λ′‖₂
    scale : scene units per dimensionless voxel
    coverage : share of the samples that are usable
    masked_by : samples left out, by cause
    """

    samples: NDArray[Any]
    weight: NDArray[Any]
    held_out: NDArray[np.bool_]
    norm: float
    scale: float
    coverage: float
    masked_by: dict[str, int] = field(default_factory=dict)

    @property
    def used_samples(self) -> NDArray[Any]:
        """``weight·samples``: what the solvers are given."""
        used: NDArray[Any] = self.samples * self.weight
        return used

    def masked(self, operator: Operator) -> MaskedOperator:
        """The solvers' operator: weighted, of norm at most 1."""
        return MaskedOperator(operator, self.weight / self.samples.dtype.type(self.norm))

    def misfit(self, predicted: NDArray[Any]) -> float:
        """RMS of ``predicted − samples`` over the samples used, relative to their RMS."""
        return _relative_rms(predicted, self.samples, self.weight > 0)

    def prediction_error(self, predicted: NDArray[Any]) -> float:
        """The same over the samples held out; NaN without any."""
        return _relative_rms(predicted, self.samples, self.held_out)


def _relative_rms(predicted: NDArray[Any], samples: NDArray[Any], where: NDArray[np.bool_]) -> float:
    if not where.any():
        return float("nan")
    error, level = np.linalg.norm((predicted - samples)[where]), np.linalg.norm(samples[where])
    return float(error / level) if level > 0 else float(error)


@dataclass(frozen=True, slots=True, eq=False)
class MaskedOperator:
    """diag(weight)·B."""

    operator: Operator
    weight: NDArray[Any]

    def forward(self, x: NDArray[Any]) -> NDArray[Any]:
        y: NDArray[Any] = self.operator.forward(x) * self.weight
        return y

    def adjoint(self, y: NDArray[Any]) -> NDArray[Any]:
        return self.operator.adjoint(y * self.weight)


def pose(
    segment: Segment, spatial_merge: int, temporal_merge: int, *, hold_out: float, seed: int = 0
) -> Problem:
    """The problem of a segment.

    ``hold_out`` is the share of usable samples kept from the solver, chosen by ``seed``.

    Raises
    ------
    UsageError : no sample is usable, or the share is not in [0, 0.5]
    NumericsError : the code is dark for the whole segment, or the samples overflow
    """
    if not 0 <= hold_out <= 0.5:
        raise UsageError(f"held-out share {hold_out}", possible="0 to 0.5")
    samples = segment.samples(np.float64)
    bad = outliers(samples, segment.mask)
    usable = segment.mask & ~np.logical_or.reduce([np.zeros_like(segment.mask), *bad.values()])
    if not usable.any():
        raise UsageError("no sample of the segment is usable", hint="another line range")
    operator = DualArm(segment.geometry, segment.code, spatial_merge, temporal_merge)
    norm = operator.norm_bound(steps=5)
    flat = operator.forward(np.ones(operator.video_shape, np.float32))
    scale = _scale(samples[usable], flat[usable])
    held_out = usable & (np.random.default_rng(seed).random(usable.shape) < hold_out)
    if not (usable & ~held_out).any():
        held_out = np.zeros_like(usable)
    return Problem(
        samples=(np.where(usable, samples, 0) / (scale * norm)).astype(np.float32),
        weight=(usable & ~held_out).astype(np.float32),
        held_out=held_out,
        norm=norm,
        scale=scale,
        coverage=float(usable.mean()),
        masked_by={"lost or saturated": int((~segment.mask).sum())}
        | {k: int(v.sum()) for k, v in bad.items()},
    )


def _scale(samples: NDArray[Any], flat: NDArray[Any]) -> float:
    """Level of the uniform scene with the same mean; 1 for a black one, where any will do."""
    level = float(np.mean(np.abs(samples), dtype=np.float64) / max(np.mean(flat, dtype=np.float64), 1e-30))
    if not np.isfinite(level):
        raise NumericsError(
            "the samples overflow", hint="check black level and responsivity of the recording"
        )
    return level or 1.0
