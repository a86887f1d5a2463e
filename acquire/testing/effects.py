"""Tests that every effect must pass: extend `EffectContract` with a fixture ``effect``."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.codes import PrbsCode, mix_seed
from acquire.config import GeometryConfig
from acquire.config.device import CameraConfig
from acquire.config.scene import SceneFile
from acquire.plugins import EFFECTS
from acquire.sim.effects.base import PLACES
from acquire.sim.leds import LedSceneConfig
from acquire.sim.pipeline import Bench

if TYPE_CHECKING:
    from acquire.sim.effects.base import Effect

STAGES, SUBSTEPS, SUBSTEP_S = 8, 3, 1e-5
CODE = PrbsCode(23, mix_seed(7, 23))
_LED = {
    "name": "x",
    "shape": "x",
    "row": 0.5,
    "column": 0.5,
    "size": 0.8,
    "drive": {"waveform": "sine", "frequency_hz": 3700.0, "low": 0.1, "high": 0.9},
}


def small_bench(effects: tuple[Effect, ...] = (), **scene: Any) -> Bench:
    """Return two 16-bit cameras of 8 stages before a blinking LED; a unit of light is 1 DN (20 electrons)."""
    table = {"kind": "leds", "leds": [_LED], "system_gain_dn_per_e": 0.05, "effects": effects}
    camera = CameraConfig(pixel_format="Mono16", black_level_dn=300.0, responsivity_dn=1.0)
    geometry = GeometryConfig(stages=STAGES, substeps=SUBSTEPS)
    shown = LedSceneConfig.model_validate(table | scene)
    return Bench(shown, geometry, {"a": camera, "b": camera}, SUBSTEP_S)


class EffectContract:
    """Needs a fixture ``effect``: an installed effect whose parameters are large enough to change lines."""

    def test_a_scene_file_finds_it_and_a_recording_gives_it_again(self, effect: Effect) -> None:
        """A recording's attributes give the same effect, and so do arguments sent to other processes."""
        assert EFFECTS.load(effect.kind) is type(effect)
        scene = small_bench((effect,)).scene
        assert SceneFile.model_validate(scene.model_dump(mode="json")).root.effects == (effect,)
        assert pickle.loads(pickle.dumps(effect)) == effect  # noqa: S301  # our own bytes

    def test_it_changes_lines_and_its_stages_say_whose_they_are(self, effect: Effect) -> None:
        """An effect that changes nothing was not applied. Errors and times are reported by its name."""
        # An effect may act on one arm only, as a misregistration does.
        changed = False
        for arm in "ab":
            camera = small_bench((effect,)).camera(arm, CODE)
            assert all(stage.effect == effect.kind and stage.place in PLACES for stage in camera.stages)
            with_it, without = camera.read(600, 1024), small_bench().camera(arm, CODE).read(600, 1024)
            changed |= not np.array_equal(with_it.pixels, without.pixels)
            changed |= not np.array_equal(with_it.missing, without.missing)
        assert changed, "the effect changes the lines of neither arm"
        assert effect.place in PLACES

    def test_lines_do_not_depend_on_how_they_are_read(self, effect: Effect) -> None:
        """Cameras deliver blocks of any size, and several processes compute them."""
        bench, again = small_bench((effect,)), small_bench((effect,)).camera("a", CODE)
        whole = bench.camera("a", CODE).read(-300, 900)
        parts, line = [], -300
        # On and off the edges of tiles of 256 lines, before and after line 0.
        for count in (1, 255, 300, 7, 337):
            parts.append(again.read(line, count))
            line += count
        np.testing.assert_array_equal(np.concatenate([part.pixels for part in parts]), whole.pixels)
        np.testing.assert_array_equal(np.concatenate([part.missing for part in parts]), whole.missing)
        # A new camera that begins here must not depend on the lines before.
        later = bench.camera("a", CODE).read(200, 300)
        np.testing.assert_array_equal(later.pixels, whole.pixels[500:800])

    def test_its_draws_are_its_own(self, effect: Effect) -> None:
        """Adding an effect must not change the draws of others, nor a test's own."""
        # An effect that drew from the stream of numpy's old functions would depend on all others that do.
        before = np.random.get_state()[1].tolist()  # type: ignore[index]  # noqa: NPY002
        first = small_bench((effect,)).camera("a", CODE).read(0, 512)
        second = small_bench((effect,)).camera("a", CODE).read(0, 512)
        np.testing.assert_array_equal(first.pixels, second.pixels, "equal seeds give different lines")
        after = np.random.get_state()[1].tolist()  # type: ignore[index]  # noqa: NPY002
        assert before == after, "it draws from numpy's global stream: use acquire.sim.effects.base.draws"
        # Compared in shape only: an effect that draws no random numbers gives the same lines.
        other = replace(small_bench((effect,)), realisation=1).camera("a", CODE).read(0, 512)
        assert other.pixels.shape == first.pixels.shape
