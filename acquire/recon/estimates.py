"""What solvers end with: a video and the lines that it predicts, however they hold it."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from acquire.arrays import host
from acquire.recon.admm import Admm

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.recon.admm import AdmmParameters
    from acquire.recon.basis import Basis
    from acquire.recon.patterns import Refinement
    from acquire.recon.problem import Operator, Problem
    from acquire.recon.twist import Twist, TwistParameters


class Estimate(Protocol):
    """A solver's state of knowledge: dimensionless video, and the lines that it predicts."""

    held_out_error: float | None
    """Relative error of the samples held out while they were; None: that of `predict`."""

    def predict(self) -> NDArray[Any]: ...

    def video(self) -> NDArray[Any]: ...

    def facts(self) -> dict[str, Any]: ...


class Onward(Protocol):
    """A solver that goes on from an estimate: an iteration, and the dimensionless video as it is now."""

    def step(self) -> None: ...

    def video(self) -> NDArray[Any]: ...


@runtime_checkable
class GoesOn(Protocol):
    """An estimate that can be gone on with, which is how the error of a video is estimated (`error`)."""

    def onward(self, problem: Problem, heavier: float = 1.0, *, still: bool = False) -> Onward | None:
        """On a problem's samples, with a prior that is so many times ``heavier``; with ``still``, that which
        a change is beside, too. None where this one cannot. The estimate stays as it is."""
        ...


class InBand:
    """Coefficient frames of an iterative solver as an estimate."""

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
        return host(self._operator.forward(self.solver.theta)) / self._problem.norm

    def video(self) -> NDArray[Any]:
        return host(self.basis.synthesize(self.solver.theta))

    def facts(self) -> dict[str, Any]:
        return {"temporal_coefficients": self.basis.count} | asdict(self._parameters)

    def step(self) -> None:
        self.solver.step()

    def onward(
        self,
        problem: Problem,
        heavier: float = 1.0,
        *,
        still: bool = False,  # noqa: ARG002
    ) -> InBand | None:
        if not isinstance(self.solver, Admm):
            return None
        solver = self.solver.on(problem.masked(self._operator), problem.used_samples, heavier)
        return InBand(solver, self._operator, self.basis, problem, self._parameters)


class Refined:
    """A refinement as an estimate."""

    held_out_error: float | None = None

    def __init__(self, refinement: Refinement, coefficients: int) -> None:
        self._refinement, self._coefficients = refinement, coefficients

    def predict(self) -> NDArray[Any]:
        return self._refinement.predict()

    def video(self) -> NDArray[Any]:
        return self._refinement.video()

    def facts(self) -> dict[str, Any]:
        found = {"temporal_coefficients": self._coefficients, "patterns": self._refinement.rank}
        return found | asdict(self._refinement.parameters)

    def onward(
        self,
        problem: Problem,
        heavier: float = 1.0,
        *,
        still: bool = False,  # noqa: ARG002
    ) -> Refinement:
        return self._refinement.on(problem, heavier)


class Preferred:
    """An estimate with the candidates that it was preferred to."""

    def __init__(self, estimate: Estimate, record: list[dict[str, Any]]) -> None:
        self._estimate, self._record, self.held_out_error = estimate, record, estimate.held_out_error
        self.predict, self.video = estimate.predict, estimate.video

    def facts(self) -> dict[str, Any]:
        return self._estimate.facts() | {"prior": "cosines", "candidates": self._record}

    def onward(self, problem: Problem, heavier: float = 1.0, *, still: bool = False) -> Onward | None:
        estimate = self._estimate
        return estimate.onward(problem, heavier, still=still) if isinstance(estimate, GoesOn) else None
