"""Interface of a solver: its own options, and a method that solves a posed problem."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Literal

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
    iterations : largest number of iterations of each preset
    passes : time of one iteration and of all work around it, in passes of the operator over all lines: a
        shorter budget is refused
    signed : it may find light below zero; otherwise that is clipped at the end
    holds_out : samples are held out, by which its prediction is judged
    goes_on : its estimates can be continued (`acquire.recon.estimates.Continuable`), which is how a video's
        error is estimated: time is reserved for it in a budget
    takes : which of ``initial``, ``denoiser`` and ``choice`` it supports
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
        """Find a video that explains ``problem.samples`` where ``problem.weight`` is 1.

        Masked and held-out samples must not be used. Every iteration is one of ``clock.run``, which ends them
        for a budget or a stop.
        """


def open_solver(name: str, options: Mapping[str, Any] | None = None) -> Solver:
    """The solver of that name with its options. Raises UsageError for an unknown name or option."""
    found: type[Solver] = SOLVERS.load(name)
    try:
        return found.model_validate(dict(options or {}))
    except ValidationError as error:
        raise UsageError(explained(error, found, f"options of solver {name}")) from error


def preset_iterations(solver: str, preset: str) -> int:
    """Largest number of iterations of a preset. Raises UsageError for an unknown solver or preset."""
    counts: Mapping[str, int] = SOLVERS.load(solver).iterations
    if preset not in counts:
        raise UsageError(f"preset {preset!r} is not known to solver {solver}", possible=", ".join(counts))
    return counts[preset]
