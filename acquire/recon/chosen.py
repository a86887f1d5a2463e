"""The estimate of the candidate that was chosen, which can go on with other samples.

The video of a trial may be a change relative to a still, which goes on with it.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from acquire.recon.basis import CyclicBasis

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.recon.problem import Problem
    from acquire.recon.workbench import Trial, Workbench


class ChosenEstimate:
    """Estimate of the candidate that was chosen."""

    def __init__(self, bench: Workbench, trial: Trial) -> None:
        self._bench, self._trial = bench, trial
        self.held_out_error: float | None = trial.error

    def predict(self) -> NDArray[Any]:
        """Return the lines of the trial and of the still that it is a change of, if any."""
        return self._bench.predict(self._trial)

    def video(self) -> NDArray[Any]:
        """Return the frames (T, n′, n′), with the still that they are a change of."""
        return self._bench.video(self._trial)

    def facts(self) -> dict[str, Any]:
        """Return the chosen prior, its weight and its band, and the record of all candidates."""
        chosen, basis = asdict(self._trial.candidate), self._trial.basis
        del chosen["coefficients"]
        chosen["temporal_coefficients"] = basis.cosines
        if isinstance(basis, CyclicBasis):
            chosen["harmonics"] = basis.harmonics
        return chosen | {"candidates": self._bench.record}

    def continue_with(self, problem: Problem, heavier: float = 1.0, *, still: bool = False) -> ContinuedTrial:
        """Continue the trial and, with ``still``, the still below it; neither changes here."""
        background = self._bench.still if still else None
        return ContinuedTrial(
            self._bench,
            _with_problem(self._trial, problem, heavier),
            None if background is None else _with_problem(background, problem, heavier),
        )


class ContinuedTrial:
    """A trial that continues, and the still that it is a change of, which is most of the picture."""

    def __init__(self, bench: Workbench, trial: Trial, still: Trial | None) -> None:
        self._bench, self._trial, self._still = bench, trial, still

    def step(self) -> None:
        """Make an iteration of the trial and, if that continues, one of its still."""
        self._trial.admm.step()
        if self._still is not None:
            self._still.admm.step()

    def video(self) -> NDArray[Any]:
        """Return the frames (T, n′, n′) so far, relative to the still as it is by now."""
        if self._still is None:
            return self._bench.video(self._trial)
        bench = self._bench.with_problem(self._bench.problem, still=self._still)
        return bench.video(replace(self._trial, bench=bench))


def _with_problem(trial: Trial, problem: Problem, heavier: float) -> Trial:
    own = trial.bench.problem
    problem = replace(problem, known_lines=own.known_lines, robust_weight=own.robust_weight)  # of its bench
    operator = problem.masked(trial.operator)
    return replace(trial, admm=trial.admm.with_problem(operator, problem.used_samples, heavier))
