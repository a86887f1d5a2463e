"""The driver "aravis" of a rig file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.camera.aravis.camera import AravisOpener
from acquire.camera.spec import spec_of
from acquire.camera.variant import CameraVariant

if TYPE_CHECKING:
    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig


class AravisCameras(CameraVariant):
    """GigE Vision and USB3 Vision cameras, without a maker's software."""

    def opener(self, config: RigConfig, arm: str, bench: Any) -> CameraOpener:  # noqa: ARG002
        return AravisOpener(spec_of(config, arm))
