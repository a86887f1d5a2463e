"""One simulated camera as a file: what Python writes and the producer reads (`layout`).

The file is anonymous memory: whoever is given the object by being spawned shares it, and the producer finds
it through a link into the owner's ``/proc/PID/fd``. When the owner dies, however it dies, it is gone.
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
"""Lines that wait for the producer: it takes them all the time, so this bridges its scheduling only."""
_AT = {name: at for at, name in enumerate(layout.WORDS)}
_POLL_S = 0.0005


class CameraMemory:
    """The memory of one camera; pickled only while a process is being spawned.

    Attributes
    ----------
    model : who the camera is
    headers : (line, 2) uint64: line id and t_ns; row ``k mod capacity`` is line k's
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
        """Where other processes find the memory while this one lives."""
        return self._memory.path

    # ---- the camera's own hand: what happens on a bench

    def unplug(self) -> None:
        """The device is gone: every access to it fails until it is opened again after `plug`."""
        self["PRESENT"] = 0

    def plug(self) -> None:
        """The device is there again, as after a loose connector: settings and clock go on."""
        if not self["PRESENT"]:
            self["PLUGGED"] += 1
            self["PRESENT"] = 1

    def inject(self, kind: str, at: int, count: int = 1) -> None:
        """Let a fault happen at frame ``at`` since acquisition start, once.

        ``BAD`` marks the frame incomplete · ``SHORT`` delivers its first ``count`` lines only; both leave id
        and time as they were in the buffer · ``DROP`` loses ``count`` frames on the link · ``OVERRUN`` finds
        no buffer for ``count`` frames · ``GONE`` unplugs the device · ``MISSED`` blinds the camera for
        ``count`` trigger pulses from line ``at`` on.
        """
        if kind not in layout.FAULT_KINDS[1:]:
            raise UsageError(f"there is no fault {kind!r}", possible=", ".join(layout.FAULT_KINDS[1:]))
        for slot in range(layout.FAULTS):
            first = layout.FAULTS_AT + slot * layout.FAULT_WORDS
            if not self._words[first] or self._words[first + 3]:
                self._words[first] = 0
                self._words[first + 1], self._words[first + 2], self._words[first + 3] = at, count, 0
                self._words[first] = layout.FAULT_KINDS.index(kind)
                return
        raise UsageError(f"more than {layout.FAULTS} faults wait to happen")

    # ---- the feeding side

    @property
    def asked(self) -> bool:
        """The host began or ended acquiring, and waits for `obey`."""
        return self["SESSION"] != self["ACK"]

    def obey(self, session: int) -> bool:
        """Tell the host that its word is done; True when lines are wanted from now on."""
        self["ACK"] = session
        return bool(session & 1)

    def write(self, first_line: int, lines: NDArray[Any], times_ns: NDArray[np.int64]) -> bool:
        """Put lines (line, pixel) into the ring; False when the host went away while it was full.

        Waits for room: the producer never leaves the ring full while it acquires.
        """
        done = 0
        while done < len(lines):
            room = self._room(min(len(lines) - done, self._capacity // 2))
            if not room:
                return False
            slot = self["HEAD"] % self._capacity
            count = min(room, len(lines) - done, self._capacity - slot)
            self.lines[slot : slot + count] = lines[done : done + count]
            header = self.headers[slot : slot + count]
            header[:, 0] = np.arange(first_line + done, first_line + done + count)
            header[:, 1] = times_ns[done : done + count]
            self["HEAD"] += count
            done += count
        return True

    def _room(self, least: int) -> int:
        while (room := self._capacity - (self["HEAD"] - self["TAIL"])) < least:
            if self.asked or not self["PRESENT"]:
                return 0
            time.sleep(_POLL_S)
        return room

    def close(self) -> None:
        """Release the memory; other holders keep theirs. Idempotent."""
        self._words.release()
        self.lines = self.headers = np.empty((0, 0), np.uint8)
        self._memory.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return CameraMemory, (self.model, self._memory)


def host_ports() -> bytes:
    """The register spaces of system and interface, one after the other."""
    return models.system().space() + models.interface().space()
