"""One simulated camera as a file, which Python writes and the producer reads (`layout`).

The file is anonymous memory: a process that receives the object when it is spawned shares it, and the
producer finds it through a link into the owner's ``/proc/PID/fd``. It disappears with the owner, however that
ends.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.processes.shared import SharedBytes
from acquire.sim.gentl import layout, models

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.sim.gentl.models import CameraModel

RING_BYTES = 64 << 20
"""Size of the ring of lines. The producer takes them continuously, so it only bridges scheduling delays."""
_AT = {name: at for at, name in enumerate(layout.WORDS)}
_POLL_S = 0.0005


class CameraMemory:
    """The memory of one camera; pickled only while a process is being spawned.

    Attributes
    ----------
    model : the camera
    headers : (line, 2) uint64: line id and t_ns; row ``k mod capacity`` belongs to line k
    lines : (line, pixel) uint8 or uint16
    """

    def __init__(self, model: CameraModel, memory: SharedBytes | None = None) -> None:
        self.model = model
        width, sample = model.sensor_width, model.sample_bytes
        self._capacity = max(1024, min(65536, RING_BYTES // (width * sample)))
        headers_at = layout.PORTS_AT + len(layout.PORTS) * layout.PORT_BYTES
        lines_at = headers_at + self._capacity * layout.HEADER_BYTES
        self._memory = memory or SharedBytes(
            f"camera-{model.serial}", lines_at + self._capacity * width * sample
        )
        self._words = self._memory.words(0, layout.FAULTS_AT + layout.FAULTS * layout.FAULT_WORDS)
        shared, count = self._memory.map, self._capacity
        self.headers = np.frombuffer(shared, np.uint64, 2 * count, headers_at).reshape(count, 2)
        self.lines: NDArray[Any] = np.frombuffer(
            shared, np.uint8 if sample == 1 else np.uint16, count * width, lines_at
        ).reshape(count, width)
        if memory is None:
            self._write_model(headers_at, lines_at)

    def _write_model(self, headers_at: int, lines_at: int) -> None:
        """Write everything except lines; MAGIC comes last, since it marks the memory as complete."""
        model, shared = self.model, self._memory.map
        texts = (model.serial, model.model, models.VENDOR, model.firmware)
        for position, text in enumerate(texts):
            at = layout.TEXTS_AT + position * layout.TEXT_BYTES
            encoded = text.encode()[: layout.TEXT_BYTES - 1]
            shared[at : at + len(encoded)] = encoded
        for position, module in enumerate((models.remote(model), models.device(model), models.stream())):
            at = layout.PORTS_AT + position * layout.PORT_BYTES
            shared[at : at + layout.PORT_BYTES] = module.space()
        facts = {
            "VERSION": layout.VERSION,
            "SENSOR_WIDTH": model.sensor_width,
            "SAMPLE_BYTES": model.sample_bytes,
            "SENSOR_BITS": model.bits,
            "LINE_CAPACITY": self._capacity,
            "LINE_STRIDE": model.sensor_width * model.sample_bytes,
            "HEADERS_AT": headers_at,
            "LINES_AT": lines_at,
            "ROW_PADDING": model.row_padding,
            "ID_BITS": model.id_bits,
            "ID_FIRST": model.id_first,
            "PRESENT": 1,
            "PLUGGED": 1,
        }
        for name, value in facts.items():
            self[name] = value
        self["MAGIC"] = layout.MAGIC

    def __getitem__(self, name: str) -> int:
        return int(self._words[_AT[name]])

    def __setitem__(self, name: str, value: int) -> None:
        self._words[_AT[name]] = value

    @property
    def path(self) -> str:
        """Path at which other processes find the memory while this process lives."""
        return self._memory.path

    # ---- events on the bench

    def unplug(self) -> None:
        """Unplug the device: every access to it fails until it is opened again after `plug`."""
        self["PRESENT"] = 0

    def plug(self) -> None:
        """Plug the device in again, as after a loose connector: its settings and its clock are kept."""
        if not self["PRESENT"]:
            self["PLUGGED"] += 1
            self["PRESENT"] = 1

    def inject(self, kind: str, at: int, count: int = 1) -> None:
        """Inject a fault at frame ``at`` since acquisition start, once.

        ``BAD`` marks the frame incomplete · ``SHORT`` delivers only its first ``count`` lines; both leave id
        and time as they were in the buffer · ``DROP`` loses ``count`` frames on the link · ``OVERRUN`` finds
        no buffer for ``count`` frames · ``GONE`` unplugs the device · ``MISSED`` makes the camera miss
        ``count`` trigger pulses from line ``at`` on.
        """
        if kind not in layout.FAULT_KINDS[1:]:
            raise UsageError(f"there is no fault {kind!r}", possible=", ".join(layout.FAULT_KINDS[1:]))
        for slot in range(layout.FAULTS):
            first = layout.FAULTS_AT + slot * layout.FAULT_WORDS
            if not self._words[first] or self._words[first + 3]:
                # The kind comes last: the producer must not see it before the fault's other words.
                self._words[first] = 0
                self._words[first + 1], self._words[first + 2], self._words[first + 3] = at, count, 0
                self._words[first] = layout.FAULT_KINDS.index(kind)
                return
        raise UsageError(f"no more than {layout.FAULTS} faults can be pending")

    # ---- the feeder

    @property
    def request_pending(self) -> bool:
        """True if the host started or stopped acquisition, and waits for `acknowledge`."""
        return self["SESSION"] != self["ACK"]

    def acknowledge(self, session: int) -> bool:
        """Report to the host that its request is done; return True if lines are wanted from now on."""
        self["ACK"] = session
        return bool(session & 1)

    def write(self, first_line: int, lines: NDArray[Any], times_ns: NDArray[np.int64]) -> bool:
        """Put lines (line, pixel) into the ring; return False if the host left while the ring was full.

        Waits for room, since the producer empties the ring as long as it acquires.
        """
        done = 0
        while done < len(lines):
            # Half of the ring at most: a block that is larger than the ring would wait for ever.
            needed = min(len(lines) - done, self._capacity // 2)
            while (room := self._capacity - (self["HEAD"] - self["TAIL"])) < needed:
                if self.request_pending or not self["PRESENT"]:
                    return False
                time.sleep(_POLL_S)
            slot = self["HEAD"] % self._capacity
            count = min(room, len(lines) - done, self._capacity - slot)
            self.lines[slot : slot + count] = lines[done : done + count]
            header = self.headers[slot : slot + count]
            header[:, 0] = np.arange(first_line + done, first_line + done + count)
            header[:, 1] = times_ns[done : done + count]
            # Last: the producer takes lines as soon as HEAD counts them.
            self["HEAD"] += count
            done += count
        return True

    def close(self) -> None:
        """Release this process's mapping of the memory. Idempotent."""
        self._words.release()
        self.lines = self.headers = np.empty((0, 0), np.uint8)
        self._memory.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return CameraMemory, (self.model, self._memory)


def host_ports() -> bytes:
    """Return the register spaces of system and interface, one after the other."""
    return models.system().space() + models.interface().space()
