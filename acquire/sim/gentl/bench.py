"""A directory that any GenICam program can load: the producer, and next to it its cameras.

Closing it ends the feeding processes and removes the cameras. If the owner is killed, the cameras' memory is
freed with it, and only a directory of dead links remains.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from acquire.errors import UsageError
from acquire.processes.messages import Ready
from acquire.processes.worker import Worker
from acquire.sim.gentl import layout
from acquire.sim.gentl.build import build
from acquire.sim.gentl.feeder import feed
from acquire.sim.gentl.memory import CameraMemory, host_ports
from acquire.text import shortened

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from types import TracebackType

    from acquire.sim.gentl.models import CameraModel

CTI = "simulated.cti"
_START_S = 20.0
_END_S = 5.0


class GentlBench:
    """Simulated cameras behind a real GenTL producer; a context manager.

    Parameters
    ----------
    cameras : model of each camera → opener of its sensor, which is called in a separate process
    life : main function of such a process, `acquire.sim.gentl.feeder.feed` except in tests

    Raises DeviceError without a C compiler, and leaves nothing behind; UsageError for equal serials, or
    one that cannot be a file's name.
    """

    def __init__(self, cameras: Mapping[CameraModel, Any], life: Callable[..., None] = feed) -> None:
        producer = build()
        serials = [model.serial for model in cameras]
        if len(set(serials)) < len(serials):
            raise UsageError(
                f"simulated cameras cannot have the serials {', '.join(serials)}",
                possible="a different serial for each",
            )
        for serial in serials:
            if "/" in serial or "\0" in serial or not 0 < len(serial.encode()) < layout.TEXT_BYTES:
                raise UsageError(
                    f"a simulated GenTL camera cannot have the serial {shortened(serial)!r}",
                    possible=f"1 to {layout.TEXT_BYTES - 1} bytes without a slash: it names a file",
                )
        self._directory = Path(tempfile.mkdtemp(prefix="acquire-gentl-"))
        self.cameras: dict[str, CameraMemory] = {}
        self._feeders: list[Worker] = []
        try:
            # A copy, not a link: the producer looks for its cameras in its own directory.
            shutil.copy(producer, self.cti)
            (self._directory / layout.HOST_FILE).write_bytes(host_ports())
            for model, opener in cameras.items():
                memory = self.cameras[model.serial] = CameraMemory(model)
                (self._directory / f"{model.serial}{layout.SUFFIX}").symlink_to(memory.path)
                self._feeders.append(Worker(f"sensor {model.serial}", life, memory, opener))
            # All are started before the first is awaited: each takes its time to import what it needs.
            deadline = time.monotonic() + _START_S
            for feeder in self._feeders:
                feeder.expect(Ready, deadline)
        except BaseException:
            self.close()
            raise

    @property
    def cti(self) -> Path:
        """Path of the producer."""
        return self._directory / CTI

    def close(self) -> None:
        """End the feeders, and remove the cameras and the directory. Idempotent."""
        deadline = time.monotonic() + _END_S
        for feeder in self._feeders:
            feeder.end(deadline)
        self._feeders.clear()
        for memory in self.cameras.values():
            memory.close()
        self.cameras.clear()
        shutil.rmtree(self._directory, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
