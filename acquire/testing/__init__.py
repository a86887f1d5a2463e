"""Contract suites: what every effect, scene, solver, denoiser and driver must do, as tests for anybody.

::

    cameras     CameraContract      a way to a camera, and what its lines must be
    triggers    TriggerContract     a sync trigger
    effects     EffectContract      an effect on a small bench
    scenes      SceneContract       a scene, asked for its light in several ways
    solvers     SolverContract      a solver on noisy lines of a scene that is known
                DenoiserContract    a denoiser of frames
    adjoints    assert_adjoint      an operator and its transpose

A suite is a class: extend it in a test module of your own, give it the fixture that its docstring asks for,
and pytest does the rest. Ours are tested by the same classes. Needs pytest, and nothing else here does.
"""

from typing import TYPE_CHECKING

import pytest

from acquire.lazy import lazily

if TYPE_CHECKING:
    from acquire.testing.adjoints import assert_adjoint
    from acquire.testing.cameras import CameraContract, CameraStand
    from acquire.testing.effects import EffectContract
    from acquire.testing.scenes import SceneContract
    from acquire.testing.solvers import DenoiserContract, SolverContract
    from acquire.testing.triggers import TriggerContract

_HOMES = {
    "CameraContract": "cameras",
    "CameraStand": "cameras",
    "DenoiserContract": "solvers",
    "EffectContract": "effects",
    "SceneContract": "scenes",
    "SolverContract": "solvers",
    "TriggerContract": "triggers",
    "assert_adjoint": "adjoints",
}
"""Imported when they are asked for: who tests a camera need not have the solvers' libraries."""

pytest.register_assert_rewrite(*sorted({f"{__name__}.{home}" for home in _HOMES.values()}))

__all__ = [
    "CameraContract",
    "CameraStand",
    "DenoiserContract",
    "EffectContract",
    "SceneContract",
    "SolverContract",
    "TriggerContract",
    "assert_adjoint",
]
__getattr__, __dir__ = lazily(__name__, _HOMES, __all__)
