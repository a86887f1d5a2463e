"""The process of a simulated GigE Vision camera: it answers control packets, and sends what its sensor reads
out, ``Height`` lines at a time. One per loopback address.
"""

from __future__ import annotations

import select
import socket
import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DeviceError
from acquire.sim.gentl.layout import PIXEL_FORMATS, REGISTERS, XML_AT
from acquire.sim.gentl.models import VENDOR, CameraModel, gige
from acquire.sim.gige import protocol
from acquire.stream.messages import Ready

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.sim.gentl.feeder import Sensor
    from acquire.stream.process import Mailbox

_IDLE_S = 0.01
_BLOCK_WAIT_S = 0.002
_BASE = protocol.BOOTSTRAP_BYTES


def serve(
    mailbox: Mailbox, model: CameraModel, opener: Callable[[], Any], address: str = "127.0.0.1"
) -> None:
    """Life of the camera: control and lines in turn, until told to end."""
    with GigeCamera(model, opener(), address) as camera:
        mailbox.post(Ready())
        while True:
            mailbox.take()
            camera.turn()


class GigeCamera:
    """See the module. Raises DeviceError when the address is taken."""

    def __init__(self, model: CameraModel, sensor: Sensor, address: str) -> None:
        space = gige(model).space(_BASE)
        url = f"Local:camera.xml;{_BASE + XML_AT:X};{len(gige(model).xml(_BASE)):X}"
        texts = {
            protocol.VENDOR: VENDOR,
            protocol.MODEL: model.model,
            protocol.FIRMWARE: model.firmware,
            protocol.SERIAL: model.serial,
            protocol.XML_URL: url,
        }
        self._registers = protocol.Registers(space, texts, socket.inet_aton(address))
        self._sensor, self._bits = sensor, model.bits
        self._control = [_bound(address, shared=False), _bound("255.255.255.255", shared=True)]
        self._lines = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._lines.bind((address, 0))
        self._acquiring = False
        self._frames = 0
        self._waiting: list[tuple[int, NDArray[Any]]] = []

    def turn(self) -> None:
        """What can be done now; waits a moment when there is nothing."""
        ready, _, _ = select.select(self._control, [], [], 0 if self._acquiring else _IDLE_S)
        for control in ready:
            self._answer(control)
        if self._acquiring and (block := self._sensor.next_block(_BLOCK_WAIT_S)) is not None:
            time_ns = int(self._sensor.times_ns(block.first_line, 1)[0])
            self._waiting.append((time_ns, np.array(block.pixels)))
            self._send_whole_frames()

    def _answer(self, control: socket.socket) -> None:
        packet, sender = control.recvfrom(2048)
        request = protocol.parse(packet)
        reply = self._registers.handle(request) if request is not None else None
        if reply is not None:
            self._obey()  # the host may start the trigger once it has the answer
            self._control[0].sendto(reply, sender)

    def _obey(self) -> None:
        """Commands are registers that the host sets; reading them back as 0 says that they are done."""
        stored = next(
            stored for at, _, stored in PIXEL_FORMATS.values() if at == self._register("PixelFormat")
        )
        pixels = self._register("Width") * self._register("Height")
        self._set_register("PayloadSize", pixels * stored // 8)
        for name, wanted in (("AcquisitionStop", False), ("AcquisitionStart", True)):
            if self._register(name):
                self._set_register(name, 0)
                self._acquiring = wanted
                self._waiting.clear()
                self._frames = 0
                if wanted:
                    self._sensor.arm()
                else:
                    self._sensor.disarm()

    def _send_whole_frames(self) -> None:
        height = self._register("Height")
        while sum(len(lines) for _, lines in self._waiting) >= height:
            time_ns = self._waiting[0][0]
            lines = np.concatenate([lines for _, lines in self._waiting])
            self._send(time_ns, lines[:height])
            rest = lines[height:]
            self._waiting = [(time_ns, rest)] if len(rest) else []

    def _send(self, time_ns: int, lines: NDArray[Any]) -> None:
        code = self._register("PixelFormat")
        offset, width = self._register("OffsetX"), self._register("Width")
        data = _pack(lines[:, offset : offset + width], self._bits, code)
        number = 1 + self._frames % 0xFFFF
        self._frames += 1
        frame = protocol.Frame(number, time_ns, code, width, len(lines), data)
        port = self._registers.get(protocol.STREAM_PORT) & 0xFFFF
        host = socket.inet_ntoa(struct.pack(">I", self._registers.get(protocol.STREAM_ADDRESS)))
        for packet in protocol.packets(frame, self._registers.get(protocol.PACKET_SIZE) & 0xFFFF):
            self._lines.sendto(packet, (host, port))

    def _register(self, name: str) -> int:
        value: int = struct.unpack_from("<Q", self._registers.memory, _BASE + REGISTERS[name])[0]
        return value

    def _set_register(self, name: str, value: int) -> None:
        struct.pack_into("<Q", self._registers.memory, _BASE + REGISTERS[name], value)

    def __enter__(self) -> GigeCamera:
        return self

    def __exit__(self, *_: object) -> None:
        for used in (*self._control, self._lines):
            used.close()


def _bound(host: str, *, shared: bool) -> socket.socket:
    """Broadcasts look for every camera: all of them listen to the one address."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, shared)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    try:
        made.bind((host, protocol.PORT))
    except OSError as error:
        made.close()
        raise DeviceError(f"GigE Vision camera on {host}: {error.strerror}") from error
    return made


def _pack(lines: NDArray[Any], bits: int, code: int) -> bytes:
    """Lines as the pixel format has them (unpacked ones only)."""
    want, stored = next((want, stored) for at, want, stored in PIXEL_FORMATS.values() if at == code)
    values = lines >> (bits - want) if bits > want else lines << (want - bits)
    return values.astype("<u2" if stored == 16 else "u1").tobytes()
