"""The simulated cameras of a rig behind the GenTL producer: one bench for all, made when first opened."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.camera.harvesters import HarvestersOpener
from acquire.camera.spec import spec_of
from acquire.lines import ARMS
from acquire.sim.gentl.bench import GentlBench
from acquire.sim.gentl.models import CameraModel

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig

DRIVER = "gentl-simulated"


class GentlArms:
    """Openers of the arms whose driver is "gentl-simulated"; starts nothing before the first is requested."""

    def __init__(self, config: RigConfig) -> None:
        self._config = config
        self._bench: GentlBench | None = None

    def opener(self, arm: str, sensor: Callable[[str], CameraOpener]) -> CameraOpener:
        """Return the opener of the arm's camera through harvesters; ``sensor`` supplies the model behind it.

        Raises DeviceError without a C compiler.
        """
        if self._bench is None:
            arms = [name for name in ARMS if self._config.cameras.arm(name).driver == DRIVER]
            # with columns of their own, both arms are on one camera
            arms = arms[:1] if self._config.columns else arms
            self._bench = GentlBench({model_of(self._config, name): sensor(name) for name in arms})
        return HarvestersOpener(spec_of(self._config, arm, str(self._bench.cti)))

    def close(self) -> None:
        """Remove the cameras. Idempotent."""
        if self._bench is not None:
            self._bench.close()
            self._bench = None


def model_of(config: RigConfig, arm: str) -> CameraModel:
    """Return the camera that the rig file describes for an arm."""
    camera = config.cameras.arm(arm)
    return CameraModel(
        camera.serial,
        sensor_width=sensor_width(config),
        bits=camera.bits,
        line_rate_hz=config.line_rate_hz,
        pixel_format=camera.pixel_format,
    )


def sensor_width(config: RigConfig) -> int:
    """Return the pixels of the camera's lines: one arm's, or enough for both arms on one sensor."""
    return max((end for _, end in config.columns.values()), default=config.pixels)
