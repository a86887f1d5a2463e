"""What a solver is: options of its own, and a way from a posed problem to a video."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

from pydantic import ValidationError

from acquire.config.base import FrozenModel
from acquire.config.findings import explained
from acquire.errors import UsageError
from acquire.plugins import SOLVERS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.estimates import Estimate
    from acquire.recon.options import SolveOptions
    from acquire.recon.problem import Problem

Preset = Literal["fast", "balanced", "best"]


class Solver(FrozenModel, ABC):
    """A solver with its options (``reconstruct(solver_options=…)``, ``--set KEY=VALUE``), none by default.

    Attributes
    ----------
    iterations : most iterations of each preset
    passes : what one iteration and all around it take, in passes of the operator over all lines: a budget
        that is shorter is refused
    signed : it may find light below zero; else that is cut off at the end
    holds_out : samples are kept from it, by which its prediction is judged
    goes_on : its estimates can be gone on with (`acquire.recon.estimates.GoesOn`): of a budget, time is kept
        for the error of the video, which is estimated by that
    takes : which of ``initial`` and ``denoiser`` it knows
    """

    iterations: ClassVar[Mapping[Preset, int]] = {"fast": 60, "balanced": 200, "best": 400}
    passes: ClassVar[float] = 14.0
    signed: ClassVar[bool] = False
    holds_out: ClassVar[bool] = True
    goes_on: ClassVar[bool] = False
    takes: ClassVar[frozenset[str]] = frozenset()

    @abstractmethod
    def solve(
        self, segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock
    ) -> Estimate:
        """A video that explains ``problem.samples`` where ``problem.weight`` is 1: what is masked or held out
        is not looked at. Every iteration is one of ``clock.run``, which ends them for a budget or a stop.
        """


def open_solver(name: str, options: Mapping[str, Any] | None = None) -> Solver:
    """The solver of that name with its options. Raises UsageError for a name or an option that is none."""
    found: type[Solver] = SOLVERS.load(name)
    try:
        return found.model_validate(dict(options or {}))
    except ValidationError as error:
        raise UsageError(explained(error, found, f"options of solver {name}")) from error


def preset_iterations(solver: str, preset: str) -> int:
    """Most iterations of a preset; UsageError for names that are none."""
    counts: Mapping[str, int] = SOLVERS.load(solver).iterations
    if preset not in counts:
        raise UsageError(f"preset {preset!r} is not known", possible=", ".join(get_args(Preset)))
    return counts[preset]
