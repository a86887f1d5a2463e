"""The problem that solvers solve: dimensionless samples, with a mask and an operator of norm at most 1.

Dividing by the operator's norm bound and by the scene's mean makes λ mean the same for every segment,
whatever the camera's gain or the light. Samples that are lost, saturated or outliers are masked: their weight
is 0 and their value is never used.
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
"""Standard deviations from which residuals get less weight (95 % efficient for normal noise: Huber, Robust
Statistics), and the ratio of the standard deviation to the median absolute value of normal noise."""


class Operator(Protocol):
    """A linear map to lines (2, L_R, M) with its transpose."""

    def forward(self, x: Array, /) -> Array:
        """Return the lines (2, L_R, M) of x, which may be a video or the coefficients of one."""
        ...

    def adjoint(self, y: Array, /) -> Array:
        """Return the transpose applied to lines, in the shape of x."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Find x with ``weight·(B·x/norm) ≈ weight·samples``. Held on the host, solved where ``arrays`` says.

    Attributes
    ----------
    samples : (2, L_R, M) dimensionless, 0 where masked
    weight : (2, L_R, M) 1 where the sample is used, else 0
    held_out : (2, L_R, M) bool, samples withheld from the solver to judge its prediction
    norm : upper bound of ‖Λ′‖₂
    scale : scene units per dimensionless voxel
    coverage : share of the samples that are usable
    masked_by : number of masked samples, by cause
    arrays : library, device and dtype of the solvers' arrays
    known_lines : lines of light that is known already, as ``samples``; the solver finds the difference
    robust_weight : factor of each sample's weight in the solver; None: 1
    """

    samples: NDArray[Any]
    weight: NDArray[Any]
    held_out: NDArray[np.bool_]
    norm: float
    scale: float
    coverage: float
    masked_by: dict[str, int] = field(default_factory=dict)
    arrays: Arrays = HOST
    known_lines: NDArray[Any] | None = None
    robust_weight: NDArray[Any] | None = None

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Samples that are not masked, including the held-out ones."""
        return (self.weight > 0) | self.held_out

    @property
    def used_samples(self) -> Array:
        """``weight·samples``, the solvers' right-hand side."""
        unknown = self.samples if self.known_lines is None else self.samples - self.known_lines
        return self.arrays.asarray(unknown * self._total_weight)

    @property
    def _total_weight(self) -> NDArray[Any]:
        return self.weight if self.robust_weight is None else self.weight * self.robust_weight

    def lines_of(self, image: NDArray[Any]) -> NDArray[Any]:
        """All lines, as ``samples``, of a solution x whose ``image`` is B·x."""
        lines = image / self.norm
        return lines if self.known_lines is None else lines + self.known_lines

    def masked(self, operator: Operator) -> MaskedOperator:
        """The solvers' operator: weighted, of norm at most 1."""
        return MaskedOperator(operator, self.arrays.asarray(self._total_weight / self.norm))

    def with_robust_weights(self, predicted: NDArray[Any]) -> Problem:
        """The same problem with less weight on samples far from ``predicted``.

        These are Huber's weights with his constant: the residual of an object that passes before a still, or
        of a flash, is not normal noise and would distort every pixel. Square roots of them, since the least
        squares square a weight.
        """
        residual = np.abs(predicted - self.samples)
        usual = HUBER * NORMAL * float(np.median(residual[self.usable]))
        if not usual > 0:
            return self
        # It is 1 up to `usual`, so that normal residuals keep their weight.
        weight = np.sqrt(usual / np.maximum(residual, usual)).astype(self.weight.dtype)
        return replace(self, robust_weight=weight)

    def with_all_samples(self) -> Problem:
        """The same problem with all usable samples in use and none held out."""
        everything = np.maximum(self.weight, self.held_out.astype(self.weight.dtype))
        return replace(self, weight=everything, held_out=np.zeros_like(self.held_out))

    def holding_out(self, samples: NDArray[np.bool_]) -> Problem:
        """The same problem with exactly these samples held out, as far as they are usable."""
        held_out = self.usable & samples
        return replace(self, weight=(self.usable & ~held_out).astype(self.weight.dtype), held_out=held_out)

    def on_host(self) -> Problem:
        """The same problem with its arrays on the host."""
        return replace(self, arrays=Arrays(dtype=self.arrays.dtype))

    def misfit(self, predicted: NDArray[Any]) -> float:
        """RMS of ``predicted − samples`` over the used samples, relative to their RMS."""
        return _relative_rms(predicted, self.samples, self.weight > 0)

    def noise(self, segment: Segment) -> float:
        """RMS of the cameras' noise in all usable samples, relative to theirs; NaN if it is unknown."""
        variance, usable = segment.variance(), self.usable
        if variance is None or not usable.any():
            return float("nan")
        level = np.square(segment.samples(np.float64)[usable]).mean()
        return float(np.sqrt(variance[usable].mean() / level)) if level > 0 else float("inf")

    def prediction_error(self, predicted: NDArray[Any]) -> float:
        """As `misfit`, over the held-out samples; NaN without any."""
        return _relative_rms(predicted, self.samples, self.held_out)


def _relative_rms(predicted: NDArray[Any], samples: NDArray[Any], where: NDArray[np.bool_]) -> float:
    if not where.any():
        return float("nan")
    error, level = np.linalg.norm((predicted - samples)[where]), np.linalg.norm(samples[where])
    # In darkness there is nothing to be relative to.
    return float(error / level) if level > 0 else float(error)


@dataclass(frozen=True, slots=True, eq=False)
class MaskedOperator:
    """diag(weight)·B."""

    operator: Operator
    weight: Array

    def forward(self, x: Array) -> Array:
        """Return lines that are 0 where a sample is not used."""
        return self.operator.forward(x) * self.weight

    def adjoint(self, y: Array) -> Array:
        """Return the transpose, on which samples that are not used have no influence."""
        return self.operator.adjoint(y * self.weight)

    def near_inverse(self, damping: float) -> Callable[[Array], Array] | None:
        """Approximate (W·B·BᵀW + damping)⁻¹ for lines that are 0 where masked; None if B offers none.

        Masked samples are treated as measured, because they are correlated with the neighbouring lines.
        """
        whole = getattr(self.operator, "near_inverse", None)
        if whole is None:
            return None
        xp = namespace(self.weight)
        # With W = largest·mask, it is mask·(B·Bᵀ + damping/largest²)⁻¹/largest².
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
    """Pose the problem of a segment, to be solved in ``arrays``.

    ``hold_out`` is the share of usable samples withheld from the solver, in blocks drawn by ``seed``.

    Raises
    ------
    UsageError : no sample is usable, or the share is not in [0, 0.5]
    NumericsError : the code is dark for the whole segment, or the samples overflow
    """
    samples = segment.samples(np.float64)
    bad = outliers(samples, segment.mask)
    usable = segment.mask & ~np.logical_or.reduce([np.zeros_like(segment.mask), *bad.values()])
    if not usable.any():
        first, last = segment.first_line, segment.first_line + segment.geometry.lines - 1
        raise UsageError(
            f"no sample of lines {first} to {last} is usable: all are lost, saturated or far from the others",
            possible="lines before them, or after them; acquire info lists what is lost",
        )
    operator = DualArm(
        segment.geometry,
        segment.code,
        spatial_merge,
        temporal_merge,
        alignment=segment.alignment,
        blur=segment.blur,
    )
    # This is an upper bound, within 0.3 % after five steps. Power iteration ends below the norm, and TwIST
    # diverges.
    norm = operator.norm_bound(steps=5)
    flat = operator.forward(np.ones(operator.video_shape, np.float32))
    scale = _scale(samples[usable], flat[usable])
    # They are drawn by a seed, so that runs on the same lines are judged by the same samples.
    held_out = held_out_blocks(usable, hold_out, seed)
    # If there are very few samples, none can be spared.
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
    """Level of the uniform scene with the same mean; 1 for a black one, for which any level will do."""
    level = float(np.mean(np.abs(samples), dtype=np.float64) / max(np.mean(flat, dtype=np.float64), 1e-30))
    if not np.isfinite(level):
        raise NumericsError(
            "the samples overflow", hint="check the black level and the responsivity of the recording"
        )
    return level or 1.0
