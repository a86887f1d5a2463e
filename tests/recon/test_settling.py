"""Which λ a refinement is held at, from the errors of its rounds."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from acquire.recon.settling import BEYOND_CHANCE, LOOSENED_IN_VAIN, TIGHTER, _Course

HELD_OUT = 800
NOISE = 1.0


@dataclass
class Scripted:
    """A refinement whose rounds have the given λ, held-out error and misfit of the used samples."""

    rounds: list[tuple[float, float, float]]
    loosens: bool = True
    at_round_end: bool = True
    found: object = None
    held_at: list[float] = field(default_factory=list)
    done: int = 0

    @property
    def parameters(self) -> SimpleNamespace:
        return SimpleNamespace(tv_weight=self.rounds[min(self.done, len(self.rounds) - 1)][0])

    def step(self) -> None:
        self.done += 1

    def predict(self) -> tuple[float, float, float]:
        return self.rounds[self.done - 1]

    def video(self) -> None: ...


def course(*rounds: tuple[float, float, float], noise: float = NOISE) -> _Course:
    problem = SimpleNamespace(
        held_out=np.ones(HELD_OUT, np.bool_),
        prediction_error=lambda predicted: predicted[1],
        misfit=lambda predicted: predicted[2],
    )
    given: Any = SimpleNamespace(problem=problem, noise=noise)
    made: Any = _Course(given, Scripted(list(rounds)))  # type: ignore[arg-type]
    clock: Any = SimpleNamespace(
        iterations=len(rounds), run=lambda most, *stage, **of_stage: range(min(most, len(rounds)))
    )
    made.ended = made.refine_until_idle(clock, LOOSENED_IN_VAIN)
    return made  # type: ignore[no-any-return]


FALLING = [(8e-4, 2.0, 1.4), (4e-4, 1.6, 1.2), (2e-4, 1.3, 1.02)]


def test_one_round_in_vain_ends_the_lowering_once_noise_is_fitted() -> None:
    """Later rounds fit ever more of it, and one that happens to predict better would keep λ falling."""
    lucky = [(1e-4, 1.31, 0.95), (5e-5, 1.28, 0.8), (2.5e-5, 1.29, 0.7)]
    found = course(*FALLING, *lucky)
    assert found.ended  # type: ignore[attr-defined]
    assert found.refinement.done == 4  # type: ignore[attr-defined]
    assert found.likely_weight == TIGHTER * 2e-4


@pytest.mark.parametrize("noise", [0.5, float("nan")])
def test_three_rounds_in_vain_end_it_where_noise_is_not_fitted_or_unknown(noise: float) -> None:
    vain = [(1e-4, 1.31, 1.0), (5e-5, 1.31, 0.99), (2.5e-5, 1.31, 0.98), (1e-5, 1.31, 0.97)]
    found = course(*FALLING, *vain, noise=noise)
    assert found.ended  # type: ignore[attr-defined]
    assert found.refinement.done == len(FALLING) + LOOSENED_IN_VAIN  # type: ignore[attr-defined]


def test_the_largest_weight_that_predicts_as_well_is_held() -> None:
    within = 1 + 0.9 * BEYOND_CHANCE / (2 * HELD_OUT) ** 0.5
    found = course((8e-4, 2.0, 1.4), (4e-4, within, 1.2), (2e-4, 1.2, 1.1), (1e-4, 1.0, 1.05))
    assert found.likely_weight == 4e-4
    beyond = 1 + 1.1 * BEYOND_CHANCE / (2 * HELD_OUT) ** 0.5
    found = course((8e-4, 2.0, 1.4), (4e-4, beyond, 1.2), (2e-4, 1.2, 1.1), (1e-4, 1.0, 1.05))
    assert found.likely_weight == TIGHTER * 1e-4
