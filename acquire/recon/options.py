"""Checked options of a call of `reconstruct`."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from acquire.errors import UsageError
from acquire.geometry import is_integer
from acquire.plugins import SOLVERS
from acquire.text import shown

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from acquire.recon.denoisers import Denoiser
    from acquire.recon.reuse import Choice

NEGATIVE_SHARE = 0.01
"""Largest negative value, relative to the largest value, in a given array: signed solvers leave some."""


class Stop(Protocol):
    """Stop request, checked after every iteration; a `threading.Event` is one."""

    def is_set(self) -> bool:
        """Return whether to end with the best estimate so far."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class SolveOptions:
    """Options of a reconstruction. Raises UsageError for impossible ones."""

    spatial_merge: int
    temporal_merge: int
    solver: str
    iterations: int
    bandwidth: float | None = None
    tv_weight: float | None = None
    budget_s: float | None = None
    initial: NDArray[Any] | None = None
    static_image: NDArray[Any] | None = None
    denoiser: Denoiser | None = None
    choice: Choice | None = None

    def __post_init__(self) -> None:
        for name, number in (
            ("bandwidth", self.bandwidth),
            ("tv_weight", self.tv_weight),
            ("budget_s", self.budget_s),
        ):
            if number is not None and (isinstance(number, bool) or not isinstance(number, Real)):
                raise UsageError(f"{name} = {shown(number)} is not a number", possible="a number, or None")
        if self.bandwidth is not None and not 0 < self.bandwidth <= 1:
            raise UsageError(
                f"bandwidth {self.bandwidth} is out of range",
                possible="more than 0, up to 1 (the frames' Nyquist frequency)",
            )
        if self.tv_weight is not None and not 0 <= self.tv_weight < float("inf"):
            raise UsageError(
                f"TV weight {self.tv_weight} is out of range", possible="a finite number of at least 0"
            )
        if self.budget_s is not None and not self.budget_s > 0:
            raise UsageError(f"budget of {self.budget_s} s is out of range", possible="more than 0")
        if not is_integer(self.iterations) or self.iterations < 1:
            raise UsageError(
                f"{self.iterations!r} iterations are not possible", possible="an integer of at least 1"
            )
        # Solvers name in `takes` what they support, so that nothing is ignored silently.
        for option, given in (
            ("initial", self.initial),
            ("denoiser", self.denoiser),
            ("choice", self.choice),
        ):
            if given is not None and option not in SOLVERS.load(self.solver).takes:
                able = [repr(name) for name, each in SOLVERS.working().items() if option in each.takes]
                raise UsageError(
                    f"solver {self.solver!r} takes no {option}", possible=f"solver {', '.join(able)}"
                )

        # Imported late, because it needs these options itself.
        from acquire.recon.reuse import Choice

        if self.choice is not None and not isinstance(self.choice, Choice):
            raise UsageError(
                f"choice = {shown(self.choice)} is not the choice of another video",
                possible="acquire.recon.reuse.Choice, or None",
            )

    def check_shapes(self, size: int, video_shape: tuple[int, int, int]) -> None:
        """Raise UsageError unless the given arrays are finite and fit the segment."""
        _check_array("initial video", self.initial, video_shape)
        _check_array("static image", self.static_image, (size, size))
        # The curve is relative to the image's norm.
        if self.static_image is not None and not np.any(self.static_image):
            raise UsageError(
                "the static image is dark everywhere", possible="an image of the lit scene at rest"
            )


def check_hooks(stop: object, **functions: object) -> None:
    """Raise UsageError unless ``stop`` can be asked and the functions called. None is possible for each."""
    for name, function in functions.items():
        if function is not None and not callable(function):
            raise UsageError(f"{name} = {shown(function)} cannot be called", possible="a function, or None")
    if stop is not None and not callable(getattr(stop, "is_set", None)):
        raise UsageError(f"stop = {shown(stop)} has no method is_set", possible="a threading.Event, or None")


def check_table(name: str, table: Mapping[str, Any] | None) -> None:
    """Raise UsageError unless options are given by name, or not at all."""
    if table is not None and not (hasattr(table, "keys") and all(isinstance(key, str) for key in table)):
        raise UsageError(
            f"{name} = {shown(table)} are not named options", possible="a dictionary by name, or None"
        )


def _check_array(what: str, given: NDArray[Any] | None, shape: tuple[int, ...]) -> None:
    if given is None:
        return
    if np.shape(given) != shape:
        raise UsageError(f"{what} of shape {np.shape(given)} does not fit", possible=f"{shape}")
    if not np.isfinite(given).all():
        raise UsageError(f"{what} has values that are not finite", possible="finite numbers")
    if np.min(given) < -NEGATIVE_SHARE * np.max(np.abs(given)):
        raise UsageError(
            f"{what} has values down to {np.min(given):.3g}", possible="light: 0 or more, in any units"
        )
