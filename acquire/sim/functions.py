"""Scenes that a user writes as a Python function of time and position."""

from __future__ import annotations

import importlib
import runpy
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from pydantic import Field

from acquire.errors import UsageError
from acquire.sim.light import first_unfit
from acquire.sim.scene import SceneModel

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    LightFunction = Callable[[NDArray[Any], NDArray[Any], NDArray[Any]], Any]


class FunctionSceneConfig(SceneModel):
    """A user's Python function: (time_s (k,), row (n, 1), column (n,)) → light (k, n, n).

    Rows and columns are the centres of the pixels, 0 to 1. ``file.py:name`` is relative to the scene file.
    """

    kind: Literal["function"]
    function: str = Field(pattern=r"^.+:[A-Za-z_]\w*$", description="module:name or file.py:name")

    def build(self, size: int, substep_s: float) -> FunctionScene:
        return FunctionScene(load_function(self.function), size, substep_s)

    def anchored(self, directory: Path) -> Self:
        place, _, name = self.function.rpartition(":")
        if not place.endswith(".py"):
            return self
        return self.model_copy(update={"function": f"{(directory / place).resolve()}:{name}"})


class FunctionScene:
    """``function(time_s, row, column)`` → light (count, n, n), at the middle of sub-steps and pixels.

    Raises UsageError if the function returns another shape, values that are not finite, or negative light.
    It is called for one sub-step when the scene is made, so that errors show early.
    """

    def __init__(self, function: LightFunction, size: int, substep_s: float) -> None:
        self.size = size
        self._function, self._substep_s = function, substep_s
        centre = (np.arange(size) + 0.5) / size
        self._row, self._column = centre[:, None], centre
        self.frames(0, 1)

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        name = f"function {getattr(self._function, '__name__', repr(self._function))}"
        try:
            light = self._function((substeps + 0.5) * self._substep_s, self._row, self._column)
        except Exception as error:  # the user's own code may raise anything
            raise _raised(name, error) from error
        shape = (len(substeps), self.size, self.size)
        frames = checked_light(light, shape, name, substeps=substeps)
        # A shutter covers frames in place, and the function may have returned an array that it keeps.
        return frames.copy()


def checked_light(
    light: Any,
    shape: tuple[int, ...],
    what: str,
    *,
    first: int = 0,
    substeps: NDArray[np.int64] | None = None,
) -> NDArray[np.float32]:
    """Return light as float32 of ``shape``. Raises UsageError for anything else.

    Its frames are those from number ``first`` on, or those of ``substeps``.
    """
    try:
        frames = np.asarray(light, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise UsageError(f"the light of {what} is not an array of numbers: {error}") from error
    if frames.shape != shape:
        raise UsageError(f"the light of {what} has shape {frames.shape}", possible=f"{shape}")
    if (found := first_unfit(frames)) is not None:
        *frame, row, column = found
        where = ""
        for index in frame:  # a single picture has none
            where = f"frame {first + index}, " if substeps is None else f"sub-step {substeps[index]}, "
        raise UsageError(
            f"the light of {what} is {frames[found]:g} at {where}pixel ({row}, {column})",
            possible="finite numbers, 0 or more",
        )
    return frames


def _raised(what: str, error: Exception) -> UsageError:
    """Return the error for an exception of the user's own code, with the line that led to it."""
    frames = traceback.extract_tb(error.__traceback__)
    # Not a line of a library that this code has called.
    own = [each for each in frames if "-packages" not in each.filename] or frames
    place = f"{own[-1].filename}, line {own[-1].lineno}"
    return UsageError(f"{what} raised {type(error).__name__} in {place}: {error}")


def load_function(name: str) -> LightFunction:
    """Import ``module:name`` or run ``file.py:name``. Raises UsageError if there is no such function."""
    # from the right: a path may contain colons
    place, _, attribute = name.rpartition(":")
    try:
        if place.endswith(".py"):
            # run and not imported: the file need not be on the path, nor be named like a module
            found = runpy.run_path(str(Path(place))).get(attribute)
        else:
            found = getattr(importlib.import_module(place), attribute, None)
    except (ImportError, OSError, SyntaxError) as error:
        raise UsageError(f"scene function {name!r} cannot be loaded: {error}") from error
    except Exception as error:  # as above: a file is run, and a module imported
        raise _raised(f"scene function {name!r}", error) from error
    if not callable(found):
        raise UsageError(
            f"scene function {name!r} cannot be loaded: {place} has no function {attribute}",
            possible="MODULE:FUNCTION or FILE.py:FUNCTION",
        )
    return found  # type: ignore[no-any-return]
