"""Simulated devices: a trigger and two cameras that behave as the real ones, and what they look at.

::

    scenes (shapes) ──▶ lines: Eq. (1), streamed ──┐
    clock: the wire between trigger and cameras ───┴──▶ devices          voxels: the truth, for comparison
"""

from acquire.sim.scenes import ArrayScene, LedScene, Scene, build_scene
from acquire.sim.voxels import truth

__all__ = ["ArrayScene", "LedScene", "Scene", "build_scene", "truth"]
