"""Simulated devices: a trigger and two cameras that behave like the real ones, and the scenes before them.

::

    scenes ─▶ lines: Eq. (1), streamed ─┐
    effects: the listed stages ─────────┼─▶ pipeline: a camera's lines ─┐
                                        │                               ├─▶ devices    replay: stored lines
    light: code and drives ─────────────┘      clock: pulses on a wire ─┘
    voxels: ground truth, for comparison

    scenes    leds, digits, shutters, sprites, targets (the paper's); media (files), functions, procedural;
              drawn with shapes and kernels, or on a canvas; those of plug-ins: checked
    cameras   optics ▸ lines ▸ readout, compact (both arms on one sensor), stopwatch; pattern: without a scene
    trigger   trigger_model with trigger_registers, trigger_run, trigger_code, arming (what it refuses); or
              rtl: the gateware, and pins: what its cameras see; twin_links: a port to either
    a rig     drivers ▸ instrument; gentl, gige: cameras for any program

From Python, without files: ``Bench(scene_config, geometry, cameras, substep_s).camera("a", code)``, or a
`StreamingArm` on any object that satisfies `Scene`.

Names are imported on first use: a rig with a simulated trigger and real cameras needs no scene.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.lazy import lazily

if TYPE_CHECKING:
    from acquire.sim.functions import FunctionScene
    from acquire.sim.leds import LedScene
    from acquire.sim.lines import StreamingArm
    from acquire.sim.pipeline import Bench
    from acquire.sim.scene import ArrayScene, Scene, SumScene
    from acquire.sim.scenes import build_scene
    from acquire.sim.voxels import truth


__all__ = [
    "ArrayScene",
    "Bench",
    "FunctionScene",
    "LedScene",
    "Scene",
    "StreamingArm",
    "SumScene",
    "build_scene",
    "truth",
]
_HOMES = {
    "ArrayScene": "scene",
    "Bench": "pipeline",
    "FunctionScene": "functions",
    "LedScene": "leds",
    "Scene": "scene",
    "StreamingArm": "lines",
    "SumScene": "scene",
    "build_scene": "scenes",
    "truth": "voxels",
}

if not TYPE_CHECKING:  # a type checker would accept any name
    __getattr__, __dir__ = lazily(__name__, _HOMES, __all__)
