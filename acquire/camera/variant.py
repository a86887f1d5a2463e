"""What a camera driver is to a rig: options of its own, and what opens an arm's camera."""

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
        """What opens the camera of an arm, "a" or "b"; called here, picklable, opening nothing yet.

        ``bench`` is the rig's `acquire.sim.instrument.SimulatedDevices` where anything of it is simulated,
        else None. Raises ConfigError for what the rig's file asks for and this driver cannot do.
        """
