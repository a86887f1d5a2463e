"""What the solvers work on: samples made dimensionless, with a mask and an operator of norm at most 1.

Dividing by the operator's norm bound and by the scene's mean makes λ mean the same for every segment,
whatever the camera's gain or the light. Samples that are lost, saturated or no light at all (outliers) are
masked: their weight is 0 and their value is never looked at.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from acquire.arrays import HOST, Arrays, namespace
from acquire.errors import NumericsError, UsageError
from acquire.forward import DualArm
from acquire.recon.holdout import held_out_blocks
from acquire.recon.outliers import outliers

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.lines import Segment


HUBER, NORMAL = 1.345, 1.4826
"""Standard deviations from which residuals are doubted (95 % efficient where all is normal noise: Huber,
Robust Statistics), and one of them over the median of normal noise's size."""


class Operator(Protocol):
    """A linear map to lines (2, L_R, M) with its transpose."""

    def forward(self, x: Array, /) -> Array: ...

    def adjoint(self, y: Array, /) -> Array: ...


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Find x with ``weight·(B·x/norm) ≈ weight·samples``. Held on the host, solved where ``arrays`` says.

    Attributes
    ----------
    samples : (2, L_R, M) dimensionless, 0 where masked
    weight : (2, L_R, M) 1 where the sample counts, else 0
    held_out : (2, L_R, M) bool, samples kept from the solver to judge its prediction
    norm : upper bound of ‖Λ′‖₂
    scale : scene units per dimensionless voxel
    coverage : share of the samples that are usable
    masked_by : samples left out, by cause
    arrays : library, device and dtype of the solvers' arrays
    known : lines of light that is known already, as ``samples``; solved for is what comes to it
    doubt : share of its weight that each sample keeps, in what is solved for; None: all of it
    """

    samples: NDArray[Any]
    weight: NDArray[Any]
    held_out: NDArray[np.bool_]
    norm: float
    scale: float
    coverage: float
    masked_by: dict[str, int] = field(default_factory=dict)
    arrays: Arrays = HOST
    known: NDArray[Any] | None = None
    doubt: NDArray[Any] | None = None

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Samples that count, those held out among them."""
        return (self.weight > 0) | self.held_out

    @property
    def used_samples(self) -> Array:
        """``weight·samples``: what the solvers are given."""
        left = self.samples if self.known is None else self.samples - self.known
        return self.arrays.asarray(left * self._believed)

    @property
    def _believed(self) -> NDArray[Any]:
        return self.weight if self.doubt is None else self.weight * self.doubt

    def lines_of(self, seen: NDArray[Any]) -> NDArray[Any]:
        """All lines, as ``samples``, where ``seen`` = B·x is of what is solved for."""
        lines = seen / self.norm
        return lines if self.known is None else lines + self.known

    def masked(self, operator: Operator) -> MaskedOperator:
        """The solvers' operator: weighted, of norm at most 1."""
        return MaskedOperator(operator, self.arrays.asarray(self._believed / self.norm))

    def doubting(self, predicted: NDArray[Any]) -> Problem:
        """The same where samples that ``predicted`` misses by far count for less.

        Huber's weights with his constant: what passes before a still, or flashes, is no normal noise and
        would pull at all of it. As roots, since a weight is squared in the least squares.
        """
        off = np.abs(predicted - self.samples)
        usable = (self.weight > 0) | self.held_out
        usual = HUBER * NORMAL * float(np.median(off[usable]))
        if not usual > 0:
            return self
        doubt = np.sqrt(usual / np.maximum(off, usual)).astype(self.weight.dtype)
        return replace(self, doubt=doubt)

    def whole(self) -> Problem:
        """The same with all usable samples in use."""
        everything = np.maximum(self.weight, self.held_out.astype(self.weight.dtype))
        return replace(self, weight=everything, held_out=np.zeros_like(self.held_out))

    def keeping(self, samples: NDArray[np.bool_]) -> Problem:
        """The same with these samples, and no others, kept from the solver, as far as they are usable."""
        kept = self.usable & samples
        return replace(self, weight=(self.usable & ~kept).astype(self.weight.dtype), held_out=kept)

    def on_host(self) -> Problem:
        """The same, for what is solved on the host."""
        return replace(self, arrays=Arrays(dtype=self.arrays.dtype))

    def misfit(self, predicted: NDArray[Any]) -> float:
        """RMS of ``predicted − samples`` over the samples used, relative to their RMS."""
        return _relative_rms(predicted, self.samples, self.weight > 0)

    def noise(self, segment: Segment) -> float:
        """RMS of the cameras' noise in all usable samples, relative to theirs; NaN where it is unknown."""
        variance, usable = segment.variance(), (self.weight > 0) | self.held_out
        if variance is None or not usable.any():
            return float("nan")
        level = np.square(segment.samples(np.float64)[usable]).mean()
        return float(np.sqrt(variance[usable].mean() / level)) if level > 0 else float("inf")

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
    weight: Array

    def forward(self, x: Array) -> Array:
        return self.operator.forward(x) * self.weight

    def adjoint(self, y: Array) -> Array:
        return self.operator.adjoint(y * self.weight)

    def near_inverse(self, damping: float) -> Callable[[Array], Array] | None:
        """About (W·B·BᵀW + damping)⁻¹ for lines that are 0 where masked; None where B knows none.

        What is masked counts as seen: its lines hang together with those beside them.
        """
        whole = getattr(self.operator, "near_inverse", None)
        if whole is None:
            return None
        xp = namespace(self.weight)
        largest = float(xp.max(self.weight))
        mask = xp.astype(self.weight > 0, self.weight.dtype)
        inverse = whole(damping / largest**2)
        return lambda lines: mask * inverse(lines) / largest**2


def build_problem(
    segment: Segment,
    spatial_merge: int,
    temporal_merge: int,
    *,
    hold_out: float,
    seed: int = 0,
    arrays: Arrays = HOST,
) -> Problem:
    """The problem of a segment, to be solved in ``arrays``.

    ``hold_out`` is the share of usable samples kept from the solver, in blocks drawn by ``seed``.

    Raises
    ------
    UsageError : no sample is usable, or the share is not in [0, 0.5]
    NumericsError : the code is dark for the whole segment, or the samples overflow
    """
    samples = segment.samples(np.float64)
    bad = outliers(samples, segment.mask)
    usable = segment.mask & ~np.logical_or.reduce([np.zeros_like(segment.mask), *bad.values()])
    if not usable.any():
        raise UsageError("no sample of the segment is usable", hint="another line range")
    operator = DualArm(
        segment.geometry,
        segment.code,
        spatial_merge,
        temporal_merge,
        alignment=segment.alignment,
        blur=segment.blur,
    )
    norm = operator.norm_bound(steps=5)
    flat = operator.forward(np.ones(operator.video_shape, np.float32))
    scale = _scale(samples[usable], flat[usable])
    held_out = held_out_blocks(usable, hold_out, seed)
    if not (usable & ~held_out).any():
        held_out = np.zeros_like(usable)
    return Problem(
        samples=(np.where(usable, samples, 0) / (scale * norm)).astype(arrays.dtype),
        weight=(usable & ~held_out).astype(arrays.dtype),
        held_out=held_out,
        norm=norm,
        scale=scale,
        coverage=float(usable.mean()),
        masked_by={"lost or saturated": int((~segment.mask).sum())}
        | {k: int(v.sum()) for k, v in bad.items()},
        arrays=arrays,
    )


def _scale(samples: NDArray[Any], flat: NDArray[Any]) -> float:
    """Level of the uniform scene with the same mean; 1 for a black one, where any will do."""
    level = float(np.mean(np.abs(samples), dtype=np.float64) / max(np.mean(flat, dtype=np.float64), 1e-30))
    if not np.isfinite(level):
        raise NumericsError(
            "the samples overflow", hint="check black level and responsivity of the recording"
        )
    return level or 1.0
