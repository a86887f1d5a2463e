"""A rig's view of a camera driver: its options, and the opener of an arm's camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

from acquire.config.base import FrozenModel

if TYPE_CHECKING:
    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig


class CameraVariant(FrozenModel, ABC):
    """A driver with its options (``[cameras.a.options]``), none by default. Named by an entry point.

    Attributes
    ----------
    simulated : only a simulated trigger, or the compiled gateware, can pulse its cameras
    sees_scene : its lines are computed from the rig's scene
    sees_light : its lines follow the light's code, which is then checked while they pass
    """

    simulated: ClassVar[bool] = False
    sees_scene: ClassVar[bool] = False
    sees_light: ClassVar[bool] = True

    @abstractmethod
    def opener(self, config: RigConfig, arm: str, bench: Any) -> CameraOpener:
        """Return the picklable opener of the camera of an arm, "a" or "b"; nothing is opened yet.

        ``bench`` is the rig's `acquire.sim.instrument.SimulatedDevices` if anything of it is simulated,
        otherwise None. Raises ConfigError for settings of the rig's file that this driver does not support.
        """
