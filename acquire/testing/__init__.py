"""Contract suites: what every effect, solver, denoiser and driver must do, as tests that anybody can run.

::

    cameras     CameraContract      a way to a camera, and what its lines must be
    triggers    TriggerContract     a sync trigger
    effects     EffectContract      an effect on a small bench
    solvers     SolverContract      a solver on noisy lines of a scene that is known
    adjoints    assert_adjoint      an operator and its transpose

A suite is a class: extend it in a test module of your own, give it the fixture that its docstring asks for,
and pytest does the rest. Ours are tested by the same classes. Needs pytest, and nothing else here does.
"""

import pytest

pytest.register_assert_rewrite(
    "acquire.testing.adjoints",
    "acquire.testing.cameras",
    "acquire.testing.effects",
    "acquire.testing.solvers",
    "acquire.testing.triggers",
)
