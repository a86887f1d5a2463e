"""The process behind one simulated GenTL camera: it reads out the sensor while the host acquires.

::

    wire ──▶ SimulatedCamera (forward model) ──▶ CameraMemory ──▶ producer ──▶ any GenICam host
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Protocol

from acquire.processes.messages import Ready

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from acquire.camera.base import CameraBlock
    from acquire.processes.worker import Mailbox
    from acquire.sim.gentl.memory import CameraMemory

_IDLE_S = 0.001
_BLOCK_WAIT_S = 0.01


class Sensor(Protocol):
    """What feeds a camera: `acquire.sim.devices.SimulatedCamera`, or a test's."""

    def arm(self) -> None: ...

    def disarm(self) -> None: ...

    def next_block(self, timeout_s: float) -> CameraBlock | None: ...

    def times_ns(self, first_line: int, count: int) -> NDArray[np.int64]: ...


def feed(mailbox: Mailbox, memory: CameraMemory, opener: Callable[[], Any]) -> None:
    """Life of a feeder: obey the host's word to acquire or not, hand on lines, until told to end."""
    sensor: Sensor = opener()
    mailbox.post(Ready())
    wanted = False
    while True:
        mailbox.take()
        if memory.asked:
            session = memory["SESSION"]
            if session & 1:
                sensor.arm()
            else:
                sensor.disarm()
            wanted = memory.obey(session)
        elif not wanted:
            time.sleep(_IDLE_S)
        elif (block := sensor.next_block(_BLOCK_WAIT_S)) is not None:
            memory.write(block.first_line, block.pixels, sensor.times_ns(block.first_line, len(block.pixels)))
