"""Cameras of other distributions, whose answers are checked: see `acquire.guarded`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from acquire.camera.base import Camera, CameraBlock, CameraIdentity, CameraLoss
from acquire.errors import CameraError
from acquire.guarded import Expected, Guarded, checked_call

if TYPE_CHECKING:
    from acquire.camera.base import CameraOpener
    from acquire.camera.variant import CameraVariant
    from acquire.config import RigConfig


_PARTS: dict[str, type | tuple[type, ...]] = {
    "first_line": (int, np.integer),
    "pixels": np.ndarray,
    "flags": np.ndarray,
    "losses": tuple,
}


def _is_block(found: object) -> bool:
    return found is None or (
        isinstance(found, CameraBlock)
        and all(isinstance(getattr(found, name), kind) for name, kind in _PARTS.items())
        and all(type(loss) is CameraLoss for loss in found.losses)
    )


_OPENER = Expected(callable, "a function that opens the camera")
_OPENED = Expected.with_methods(
    Camera, "identify", "settings", "arm", "next_block", "release", "disarm", "statistics", "close"
)
_EXPECTED = {
    "identify": Expected.of_type(CameraIdentity),
    "settings": Expected.of_type(dict, "a dictionary"),
    "next_block": Expected(
        _is_block,
        "None, or a CameraBlock with a whole first_line, arrays of pixels and flags, a tuple of CameraLoss",
    ),
    "statistics": Expected.of_type(dict, "a dictionary with lines and lost"),
}


@dataclass(frozen=True, slots=True)
class CheckedOpener:
    """The opener of a camera of somebody else's driver, ``whose`` in words; picklable if theirs is."""

    whose: str
    opener: CameraOpener

    def __call__(self) -> Camera:
        opened = checked_call(self.whose, "its opener", self.opener, _OPENED, CameraError)
        return cast("Camera", Guarded(self.whose, opened, _EXPECTED, CameraError))


def checked_opener(
    whose: str, variant: CameraVariant, config: RigConfig, arm: str, bench: Any
) -> CheckedOpener:
    """Return the opener of somebody else's driver. Raises CameraError, UsageError."""
    found = checked_call(whose, "opener", lambda: variant.opener(config, arm, bench), _OPENER, CameraError)
    return CheckedOpener(whose, found)
