"""The simulated cameras of a rig behind GigE Vision, each with its own process and loopback address."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

from acquire.camera.aravis import AravisOpener, load
from acquire.camera.spec import spec_of
from acquire.lines import ARMS
from acquire.processes.messages import Ready
from acquire.processes.worker import Worker
from acquire.sim.gentl.arms import model_of
from acquire.sim.gige.camera import Transmission, serve

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig

_START_S = 20.0
_END_S = 5.0


class GigeArms:
    """Openers of the arms whose driver is "gige-simulated"; starts nothing before the first is requested."""

    def __init__(self, config: RigConfig) -> None:
        self.transmission = Transmission()
        self._config = config
        self._servers: dict[str, Worker] = {}

    def opener(self, arm: str, sensor: Callable[[str], CameraOpener]) -> CameraOpener:
        """Return the opener of the arm's camera through Aravis; ``sensor`` supplies the model behind it.

        Raises CameraError without Aravis, DeviceError if another camera has the address.
        """
        load()
        if arm not in self._servers:
            arguments = (model_of(self._config, arm), sensor(arm), address_of(arm), self.transmission)
            server = Worker(f"camera {arm}", serve, *arguments)
            self._servers[arm] = server
            server.expect(Ready, time.monotonic() + _START_S)
        return AravisOpener(spec_of(self._config, arm, address_of(arm)))

    def close(self) -> None:
        """Remove the cameras. Idempotent."""
        while self._servers:
            _, server = self._servers.popitem()
            server.end(time.monotonic() + _END_S)


def address_of(arm: str) -> str:
    """Return a loopback address that no other process of this host uses for its cameras."""
    # Not 127.0, which holds localhost, nor 127.255, which holds the broadcast address.
    # after 65 024 process ids the addresses repeat; one that is taken is refused
    pid = os.getpid() % (1 << 16)
    return f"127.{1 + pid // 256 % 254}.{pid % 256}.{1 + ARMS.index(arm)}"
