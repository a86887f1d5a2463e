"""Tests that every scene must pass: extend `SceneContract` with a fixture ``scene``."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING

import numpy as np

from acquire.config.scene import SceneFile
from acquire.plugins import SCENES
from acquire.sim.scene import SeparableScene, frames_at

if TYPE_CHECKING:
    from acquire.sim.scene import Scene, SceneModel

SIZE, SUBSTEP_S = 24, 1e-5
FIRST, COUNT = -7, 40
"""A scene has no beginning, so some of the tested sub-steps are before the run."""


class SceneContract:
    """Needs a fixture ``scene``: the model of an installed scene that is not always dark."""

    def shown(self, scene: SceneModel) -> Scene:
        """Return the scene on 24 × 24 pixels at 100 kHz; override this if your scene needs another size."""
        return scene.build(SIZE, SUBSTEP_S)

    def test_a_scene_file_finds_it_and_another_process_is_given_the_same(self, scene: SceneModel) -> None:
        """Each camera computes the scene in a process of its own."""
        assert SCENES.load(scene.kind) is type(scene)
        assert SceneFile.model_validate(scene.model_dump(mode="json")).root == scene
        assert pickle.loads(pickle.dumps(scene)) == scene  # noqa: S301  # our own bytes

    def test_it_shows_finite_light_of_the_size_that_was_asked(self, scene: SceneModel) -> None:
        """Negative or endless light would reach the lines as plausible numbers."""
        shown = self.shown(scene)
        light = shown.frames(FIRST, COUNT)
        assert light.shape == (COUNT, shown.size, shown.size)
        assert light.dtype == np.float32
        assert np.isfinite(light).all()
        assert light.min() >= 0, "the light is negative"
        assert light.max() > 0, "the scene is dark"
        assert shown.frames(3, 0).shape == (0, shown.size, shown.size), "a request for 0 sub-steps is valid"

    def test_frames_do_not_depend_on_how_they_are_asked(self, scene: SceneModel) -> None:
        """Both cameras ask for frames in an order of their own, and have to see the same."""
        shown, again = self.shown(scene), self.shown(scene)
        whole = shown.frames(FIRST, COUNT)
        # The later part first, so that nothing may be carried over from the earlier one.
        later, earlier = again.frames(FIRST + 15, COUNT - 15), again.frames(FIRST, 15)  # in any order
        np.testing.assert_array_equal(np.concatenate([earlier, later]), whole)
        some = np.array([0, 1, 5, 17, COUNT - 1])
        np.testing.assert_array_equal(frames_at(shown, FIRST + some), whole[some])

    def test_masks_and_intensities_make_its_frames(self, scene: SceneModel) -> None:
        """A scene without masks is computed frame by frame, so that there is nothing to compare."""
        shown = self.shown(scene)
        if not isinstance(shown, SeparableScene):
            return
        light, masks = shown.intensity(FIRST, COUNT), shown.masks
        assert light.shape == (len(masks), COUNT)
        assert masks.dtype == np.float32
        product = np.einsum("kt,krc->trc", light, masks)
        np.testing.assert_allclose(shown.frames(FIRST, COUNT), product, rtol=1e-4, atol=1e-6)
        # The effect `pwm` asks for steps as long as its carrier period.
        assert shown.intensity(0, 4, SUBSTEP_S / 3).shape == (len(masks), 4)
