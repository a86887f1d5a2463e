"""Estimates, the results of solvers: a video and the lines that it predicts, however they are stored."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from acquire.arrays import host
from acquire.errors import NumericsError, UsageError
from acquire.recon.admm import Admm
from acquire.recon.darkness import LitPixels
from acquire.text import shown

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.recon.admm import AdmmParameters
    from acquire.recon.basis import Basis
    from acquire.recon.patterns import Refinement
    from acquire.recon.problem import Operator, Problem
    from acquire.recon.twist import Twist, TwistParameters


class Estimate(Protocol):
    """A solver's result: a dimensionless video, and the lines that it predicts."""

    held_out_error: float | None
    """Relative error of the held-out samples before they were put to use; None: that of `predict`."""

    def predict(self) -> NDArray[Any]:
        """Return the lines (2, L_R, M) of the video in units of the problem's samples, also masked ones."""
        ...

    def video(self) -> NDArray[Any]:
        """Return the video (T, n′, n′) in units of the problem's ``scale``, possibly below 0."""
        ...

    def facts(self) -> dict[str, Any]:
        """Return what a user may want to know of the solution, as JSON: `Reconstruction.parameters`."""
        ...


def checked_answer(
    solver: str, estimate: Estimate, lines_shape: tuple[int, ...], video_shape: tuple[int, ...]
) -> tuple[NDArray[Any], NDArray[Any], dict[str, Any]]:
    """Return the predicted lines, the video and the facts of an estimate.

    Raises UsageError, with the solver's name, for what is not an estimate of that shape, and NumericsError
    for numbers that are not finite.
    """
    if not all(hasattr(estimate, name) for name in ("held_out_error", "predict", "video", "facts")):
        raise UsageError(
            f"solver {solver} gave back {shown(estimate)}",
            possible="an object with held_out_error, predict(), video() and facts()",
        )
    predicted = _checked(f"solver {solver}", "lines", estimate.predict(), lines_shape)
    video = _checked(f"solver {solver}", "a video", estimate.video(), video_shape)
    facts = estimate.facts()
    if not isinstance(facts, dict):
        raise UsageError(f"solver {solver} gave back {shown(facts)} as facts", possible="a dictionary")
    return predicted, video, facts


def _checked(solver: str, what: str, found: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    if np.shape(found) != shape:
        raise UsageError(f"{solver} gave back {what} of shape {np.shape(found)}", possible=f"shape {shape}")
    if not np.isrealobj(found):
        raise UsageError(f"{solver} gave back {what} of complex numbers", possible="real numbers")
    if not np.isfinite(found).all():
        raise NumericsError(f"{solver} gave back {what} with values that are not finite")
    return found


class ContinuingSolver(Protocol):
    """A solver that continues an estimate: `step` is an iteration, `video` the dimensionless video so far."""

    def step(self) -> None:
        """Make one iteration, which changes `video`."""

    def video(self) -> NDArray[Any]:
        """Return the dimensionless video (T, n′, n′) so far."""
        ...


@runtime_checkable
class Continuable(Protocol):
    """An estimate whose solver can be continued, which is how the error of a video is estimated (`error`)."""

    def continue_with(
        self, problem: Problem, heavier: float = 1.0, *, still: bool = False
    ) -> ContinuingSolver | None:
        """Continue with a problem's samples and a prior that is ``heavier`` by this factor; None if
        impossible.

        With ``still``, the still that a change is added to continues as well. The estimate stays as it is.
        """
        ...


class InBand:
    """Estimate held as the coefficient frames of an iterative solver."""

    held_out_error: float | None = None

    def __init__(
        self,
        solver: Admm | Twist,
        operator: Operator,
        basis: Basis,
        problem: Problem,
        parameters: AdmmParameters | TwistParameters,
    ) -> None:
        self.solver, self._parameters = solver, parameters
        self.basis, self._operator, self._problem = basis, operator, problem

    def predict(self) -> NDArray[Any]:
        """Return the lines that the coefficients predict; they were scaled to an operator of norm 1."""
        return host(self._operator.forward(self.solver.theta)) / self._problem.norm

    def video(self) -> NDArray[Any]:
        """Return the frames (T, n′, n′), which the solver itself never holds."""
        return host(self.basis.synthesize(self.solver.theta))

    def facts(self) -> dict[str, Any]:
        """Return the band that the video can hold, as runs of cosines, and the solver's parameters."""
        held = self.basis.held
        last = np.flatnonzero(np.diff(held, append=held[-1] + 2) > 1)
        first = np.concatenate([[0], last[:-1] + 1])
        # These are the runs of successive cosines, from which `reconstruct` derives ``resolved_hz``.
        bands = [(int(held[a]), int(held[b]) + 1) for a, b in zip(first, last, strict=True)]
        return {"temporal_coefficients": self.basis.cosines, "bands": bands} | asdict(self._parameters)

    def step(self) -> None:
        """Continue the solver by one iteration."""
        self.solver.step()

    def continue_with(
        self,
        problem: Problem,
        heavier: float = 1.0,
        *,
        still: bool = False,  # noqa: ARG002 (the protocol's; nothing here is added to a still)
    ) -> InBand | None:
        """Return the solver on another problem, from where this one is; None unless it is ADMM."""
        if not isinstance(self.solver, Admm):
            return None
        solver = self.solver.with_problem(problem.masked(self._operator), problem.used_samples, heavier)
        return InBand(solver, self._operator, self.basis, problem, self._parameters)


class Refined:
    """Estimate held as the patterns and curves of a refinement."""

    held_out_error: float | None = None

    def __init__(self, refinement: Refinement, coefficients: int) -> None:
        self._refinement, self._coefficients = refinement, coefficients

    def predict(self) -> NDArray[Any]:
        """Return the lines of patterns, curves and all that is beside them."""
        return self._refinement.predict()

    def video(self) -> NDArray[Any]:
        """Return the sum of curve · pattern (T, n′, n′), and of what is beside it."""
        return self._refinement.video()

    def facts(self) -> dict[str, Any]:
        """Return the numbers of patterns and of coefficients, and the share of ground taken to be dark."""
        found: dict[str, Any] = {
            "temporal_coefficients": self._coefficients,
            "patterns": self._refinement.rank,
        }
        motion = self._refinement.found.motion
        if motion is not None:
            found["motion_coefficients"] = int(motion.shape[0])
        if isinstance(self._refinement.unknowns, LitPixels):
            found["dark_share"] = float(1 - self._refinement.unknowns.lit.mean())
        return found | asdict(self._refinement.parameters)

    def continue_with(
        self,
        problem: Problem,
        heavier: float = 1.0,
        *,
        still: bool = False,  # noqa: ARG002 (the protocol's; nothing here is added to a still)
    ) -> Refinement:
        """Return a refinement that continues from here with another problem's samples and a heavier prior."""
        return self._refinement.with_problem(problem, heavier)


class Preferred:
    """An estimate together with the record of the candidates that it was preferred to."""

    def __init__(self, estimate: Estimate, record: list[dict[str, Any]]) -> None:
        self._estimate, self._record, self.held_out_error = estimate, record, estimate.held_out_error
        self.predict, self.video = estimate.predict, estimate.video

    def facts(self) -> dict[str, Any]:
        """Return the facts of the estimate, with the candidates that lost against it."""
        return self._estimate.facts() | {"prior": "cosines", "candidates": self._record}

    def continue_with(
        self, problem: Problem, heavier: float = 1.0, *, still: bool = False
    ) -> ContinuingSolver | None:
        """Continue the estimate, if that is possible."""
        if not isinstance(self._estimate, Continuable):
            return None
        return self._estimate.continue_with(problem, heavier, still=still)
