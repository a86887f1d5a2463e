"""Mistakes of an effect or a scene are refused by name: lines of wrong light would be recorded as good."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sim_helpers import CODE

from acquire.errors import NumericsError, UsageError
from acquire.sim.effects.base import Stage
from acquire.sim.effects.checked import checked_stages
from acquire.sim.light import Illumination
from acquire.sim.lines import StreamingArm
from acquire.sim.scene import ArrayScene

LINES = np.ones((4, 3))
FRAMES = np.ones((2, 6, 6), np.float32)
LIGHT = Illumination.gated(CODE.bits, lambda _first, count: np.ones((1, count)))
GIVEN = {
    "light": (LIGHT,),
    "image": (FRAMES,),
    "signal": (LINES, 0),
    "charge": (LINES, 0),
    "readout": (LINES, 0),
    "stream": (LINES.astype(np.uint16), 0, lambda: LINES[:1]),
}


def run(place, work):
    (stage,) = checked_stages("wrong", [Stage("wrong", place, work)])
    done = stage.run(*GIVEN[place])
    return done.light(0, 8) if place == "light" else done


@pytest.mark.parametrize(
    ("place", "work", "told"),
    [
        ("light", lambda light: None, "effect wrong gave back None as light"),
        ("light", lambda light: replace(light, light=lambda f, c: np.ones((1, c + 1))), r"shape \(1, 9\)"),
        ("image", lambda frames: frames[:, 1:], r"shape \(2, 5, 6\) for frames of shape \(2, 6, 6\)"),
        ("signal", lambda lines, first: lines[1:], r"shape \(3, 3\) for lines of shape \(4, 3\)"),
        ("stream", lambda pixels, first, before: pixels, "effect wrong gave back array"),
        (
            "stream",
            lambda pixels, first, before: (pixels, [True]),
            r"shape \(1,\) for which lines are missing",
        ),
    ],
)
def test_what_a_stage_gives_back_has_the_shape_of_its_place(place, work, told):
    with pytest.raises(UsageError, match=told):
        run(place, work)


@pytest.mark.parametrize("place", ["light", "image", "signal", "charge", "readout"])
def test_values_that_are_not_numbers_are_refused_with_the_effect(place):
    def hollow(given, first=0):
        if place == "light":
            return replace(given, light=lambda first, count: given.light(first, count) * np.nan)
        return given * np.nan

    with pytest.raises(NumericsError, match="effect wrong gave back values that are not numbers"):
        run(place, hollow)


def test_an_effect_is_not_blamed_for_the_scene():
    (stage,) = checked_stages("blur", [Stage("blur", "image", lambda frames: frames)])
    with pytest.raises(NumericsError, match="the scene gave back"):
        stage.run(FRAMES * np.nan)


@pytest.mark.parametrize("found", [None, [print], [Stage("wrong", "chrge", print)]])
def test_stages_that_are_none_are_refused(found):
    with pytest.raises(UsageError, match=r"effect wrong gave back .* as a stage") as refused:
        checked_stages("wrong", found)
    assert "light, image" in refused.value.possible


def test_a_scene_that_is_not_a_number_is_refused():
    with pytest.raises(NumericsError, match="the scene gave back"):
        StreamingArm(ArrayScene(FRAMES * np.nan), CODE, 3, 2, "a").lines(0, 20)


@pytest.mark.parametrize("arm", "ab")
def test_a_scene_whose_frames_change_their_size_is_refused(arm):
    """Compiled loops added them beyond the end of the lines' memory."""

    class Growing(ArrayScene):
        def frames_at(self, substeps):
            return np.ones((len(substeps), 6, 60_000), np.float32)

    with pytest.raises(UsageError, match="the scene gave back shape"):
        StreamingArm(Growing(FRAMES), CODE, 3, 2, arm).lines(0, 20)
