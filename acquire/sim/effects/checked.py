"""Stages whose results are checked, so that an error names the effect that made a mistake.

Without this, a value that is not a number is rounded to some DN and recorded as light, and frames of another
shape are added by compiled loops, which look at no bounds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import NumericsError, UsageError
from acquire.sim.effects.base import PLACES, Stage
from acquire.sim.light import Illumination
from acquire.text import shown

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


def checked_stages(effect: str, found: object) -> list[Stage]:
    """Return the stages of an effect, each checked. Raises UsageError if they are not stages."""
    stages = []
    for stage in found if isinstance(found, Iterable) else [found]:
        if not isinstance(stage, Stage) or stage.place not in PLACES:
            raise UsageError(
                f"effect {effect} gave back {shown(stage)} as a stage",
                possible=f"a list of Stage, each with one of the places {', '.join(PLACES)}",
            )
        stages.append(replace(stage, run=_CHECKED.get(stage.place, _lines)(stage)))
    return stages


def _light(stage: Stage) -> Callable[..., Any]:
    def run(light: Illumination) -> Illumination:
        changed = stage.run(light)
        if not isinstance(changed, Illumination):
            raise UsageError(
                f"effect {stage.effect} gave back {shown(changed)} as light", possible="an Illumination"
            )

        def lit(first: int, count: int) -> NDArray[Any]:
            found = changed.light(first, count)
            if np.ndim(found) != 2 or np.shape(found)[1] != count:
                raise UsageError(
                    f"effect {stage.effect} gave back shape {np.shape(found)} for {count} sub-steps of light",
                    possible=f"(source, {count})",
                )
            if np.isnan(found).any():
                raise _not_a_number(stage, light.light(first, count))
            return found

        return replace(changed, light=lit)

    return run


def _image(stage: Stage) -> Callable[..., Any]:
    def run(frames: NDArray[Any]) -> NDArray[Any]:
        return _expect(stage, stage.run(frames), frames, "frames")

    return run


def _lines(stage: Stage) -> Callable[..., Any]:
    def run(lines: NDArray[Any], first_line: int) -> NDArray[Any]:
        return _expect(stage, stage.run(lines, first_line), lines, "lines")

    return run


def _stream(stage: Stage) -> Callable[..., Any]:
    def run(pixels: NDArray[Any], first_line: int, before: Any) -> tuple[NDArray[Any], Any]:
        found = stage.run(pixels, first_line, before)
        if not (isinstance(found, tuple) and len(found) == 2):
            raise UsageError(
                f"effect {stage.effect} gave back {shown(found)}",
                possible="pixels, and which lines are missing or None",
            )
        changed = _expect(stage, found[0], pixels, "lines")
        if found[1] is not None and np.shape(found[1]) != (len(pixels),):
            raise UsageError(
                f"effect {stage.effect} gave back shape {np.shape(found[1])} for which lines are missing",
                possible=f"shape {(len(pixels),)}, or None",
            )
        return changed, found[1]

    return run


_CHECKED = {"light": _light, "image": _image, "stream": _stream}


def _expect(stage: Stage, found: NDArray[Any], given: NDArray[Any], what: str) -> NDArray[Any]:
    """Return what a stage made of lines or frames. Raises UsageError if the shape is wrong."""
    wanted = (len(given) - stage.lead, *given.shape[1:])
    if np.shape(found) != wanted:
        raise UsageError(
            f"effect {stage.effect} gave back shape {np.shape(found)} for {what} of shape {given.shape}"
            + (f" with {stage.lead} in advance" if stage.lead else ""),
            possible=f"shape {wanted}",
        )
    if np.isnan(found).any():
        raise _not_a_number(stage, given)
    return found


def _not_a_number(stage: Stage, given: NDArray[Any]) -> NumericsError:
    # The effects before it were checked: what was no number when it came is the scene's.
    name = "the scene" if np.isnan(given).any() else f"effect {stage.effect}"
    return NumericsError(f"{name} gave back values that are not numbers (NaN)")
