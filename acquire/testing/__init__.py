"""Contract suites: tests that every effect, scene, codec, solver, denoiser and driver must pass.

::

    cameras     CameraContract      a camera driver, and the lines that it delivers
    triggers    TriggerContract     a sync trigger
    codecs      CodecContract       a codec of recorded lines
    effects     EffectContract      an effect on a small bench
    scenes      SceneContract       a scene whose light is requested in several ways
    solvers     SolverContract      a solver on noisy lines of a known scene
                DenoiserContract    a denoiser of frames
    adjoints    assert_adjoint      an operator and its transpose

A suite is a class: extend it in your own test module, for a plug-in of yours, and provide the fixture that
its docstring names; pytest collects the tests. The built-in classes are tested with the same suites. Only
this package needs pytest.
"""

from typing import TYPE_CHECKING

import pytest

from acquire.lazy import lazily

if TYPE_CHECKING:
    from acquire.testing.adjoints import assert_adjoint
    from acquire.testing.cameras import CameraContract, CameraStand
    from acquire.testing.codecs import CodecContract
    from acquire.testing.effects import EffectContract
    from acquire.testing.scenes import SceneContract
    from acquire.testing.solvers import DenoiserContract, SolverContract
    from acquire.testing.triggers import TriggerContract

_HOMES = {
    "CameraContract": "cameras",
    "CameraStand": "cameras",
    "CodecContract": "codecs",
    "DenoiserContract": "solvers",
    "EffectContract": "effects",
    "SceneContract": "scenes",
    "SolverContract": "solvers",
    "TriggerContract": "triggers",
    "assert_adjoint": "adjoints",
}
"""Imported on first use, so that tests of a camera do not need the solvers' libraries."""

pytest.register_assert_rewrite(*sorted({f"{__name__}.{home}" for home in _HOMES.values()}))

__all__ = [
    "CameraContract",
    "CameraStand",
    "CodecContract",
    "DenoiserContract",
    "EffectContract",
    "SceneContract",
    "SolverContract",
    "TriggerContract",
    "assert_adjoint",
]
if not TYPE_CHECKING:  # a type checker would accept any name
    __getattr__, __dir__ = lazily(__name__, _HOMES, __all__)
