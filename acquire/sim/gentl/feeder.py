"""The process behind one simulated GenTL camera: it reads out the sensor while the host is acquiring.

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


class LineSource(Protocol):
    """The source of a camera's lines: `acquire.sim.devices.SimulatedCamera`, or a test's own."""

    def arm(self) -> None:
        """Begin at line 0 of the next run of pulses."""

    def disarm(self) -> None:
        """End; the next `arm` counts anew."""

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """Return the next lines; None if none came within ``timeout_s``."""
        ...

    def times_ns(self, first_line: int, count: int) -> NDArray[np.int64]:
        """Return when lines were read out, by the camera's own clock, for the stamps of frames."""
        ...


def feed(mailbox: Mailbox, memory: CameraMemory, opener: Callable[[], Any]) -> None:
    """Main function of a feeder: follow the host's start and stop requests and pass on lines."""
    sensor: LineSource = opener()
    mailbox.post(Ready())
    acquiring = False
    while True:
        mailbox.take()  # raises when the owner ends the process
        if memory.request_pending:
            session = memory["SESSION"]
            if session & 1:
                sensor.arm()
            else:
                sensor.disarm()
            acquiring = memory.acknowledge(session)
        elif not acquiring:
            time.sleep(_IDLE_S)
        elif (block := sensor.next_block(_BLOCK_WAIT_S)) is not None:
            memory.write(block.first_line, block.pixels, sensor.times_ns(block.first_line, len(block.pixels)))
