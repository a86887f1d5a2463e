"""The process of a simulated GigE Vision camera: it answers control packets, and sends what its sensor reads
out, ``Height`` lines at a time. One per loopback address.

Packets that the host misses are sent again while the camera still has their frame.
"""

from __future__ import annotations

import select
import socket
import struct
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DeviceError
from acquire.processes.messages import Ready
from acquire.sim.gentl.layout import PIXEL_FORMATS, REGISTERS, XML_AT
from acquire.sim.gentl.models import VENDOR, CameraModel, gige
from acquire.sim.gige import protocol

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.processes.worker import Mailbox
    from acquire.sim.gentl.feeder import Sensor

_IDLE_S = 0.01
_BLOCK_WAIT_S = 0.002
_BASE = protocol.BOOTSTRAP_BYTES


_KEPT_FRAMES = 16
"""Of which packets can be sent again."""
Link = Callable[[int, list[bytes]], Iterable[bytes]]
"""Which of a frame's packets reach the host, and in what order; frames count from 0."""


@dataclass(frozen=True, slots=True)
class Transmission:
    """How frames are numbered, and what becomes of them on their way. Picklable if ``link`` is.

    ``first_id`` : of every acquisition; ids skip 0. ``extended`` : ids of 64 bits instead of 16.
    ``resends`` : packets are sent again when the host asks. ``link`` : None loses nothing.
    """

    first_id: int = 1
    extended: bool = False
    resends: bool = True
    link: Link | None = None

    def frame_id(self, frame: int) -> int:
        """The id of a frame; frames count from 0."""
        return 1 + (self.first_id - 1 + frame) % (2**64 - 1 if self.extended else 0xFFFF)


def serve(
    mailbox: Mailbox,
    model: CameraModel,
    opener: Callable[[], Any],
    address: str = "127.0.0.1",
    transmission: Transmission = Transmission(),
) -> None:
    """Life of the camera: control and lines in turn, until told to end."""
    with GigeCamera(model, opener(), address, transmission) as camera:
        mailbox.post(Ready())
        while True:
            mailbox.take()
            camera.turn()


class GigeCamera:
    """See the module. Raises DeviceError when the address is taken."""

    def __init__(self, model: CameraModel, sensor: Sensor, address: str, transmission: Transmission) -> None:
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
        self.transmission = transmission
        if not transmission.resends:
            self._registers.set(protocol.CAPABILITY, 0)
        self._sensor, self._bits = sensor, model.bits
        self._control = [_bound(address, shared=False), _bound("255.255.255.255", shared=True)]
        self._lines = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._lines.bind((address, 0))
        self._answered: tuple[Any, protocol.Request | None, bytes | None] = (None, None, None)
        self._acquiring = False
        self._frames = 0
        self._sent: deque[tuple[int, list[bytes]]] = deque(maxlen=_KEPT_FRAMES)
        self._waiting: list[tuple[int, NDArray[Any]]] = []

    def turn(self) -> None:
        """What can be done now; waits a moment when there is nothing."""
        ready, _, _ = select.select(self._control, [], [], 0 if self._acquiring else _IDLE_S)
        for control in ready:
            self._answer(control)
        if self._acquiring and (block := self._sensor.next_block(_BLOCK_WAIT_S)) is not None:
            self._waiting.append((block.first_line, np.array(block.pixels)))
            height = self._register("Height")
            while sum(len(lines) for _, lines in self._waiting) >= height:
                first_line = self._waiting[0][0]
                lines = np.concatenate([lines for _, lines in self._waiting])
                self._send(int(self._sensor.times_ns(first_line, 1)[0]), lines[:height])
                rest = lines[height:]
                self._waiting = [(first_line + height, rest)] if len(rest) else []

    def _answer(self, control: socket.socket) -> None:
        packet, sender = control.recvfrom(2048)
        request = protocol.parse(packet)
        if request is None:
            return
        if request.command == protocol.Command.RESEND:
            # Of a frame that is not kept any more nothing is answered: the host gives it up.
            number, first, last = protocol.parse_resend(request)
            for kept, packets in self._sent if self.transmission.resends else ():
                if kept == number:
                    self._put(packets[first : last + 1])
            return
        if (sender, request) != self._answered[:2]:  # else the host has not seen the answer in time
            self._answered = (sender, request, self._registers.handle(request))
            self._obey()  # the host may start the trigger once it has the answer
        reply = self._answered[2]
        if reply is not None:
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
                self._sent.clear()
                self._frames = 0
                if wanted:
                    self._sensor.arm()
                else:
                    self._sensor.disarm()

    def _send(self, time_ns: int, lines: NDArray[Any]) -> None:
        code = self._register("PixelFormat")
        offset, width = self._register("OffsetX"), self._register("Width")
        data = _pack(lines[:, offset : offset + width], self._bits, code)
        sent = self.transmission
        number = sent.frame_id(self._frames)
        frame = protocol.Frame(
            number=number,
            time_ns=time_ns,
            pixel_format=code,
            width=width,
            height=len(lines),
            data=data,
            extended=sent.extended,
        )
        packets = list(protocol.packets(frame, self._registers.get(protocol.PACKET_SIZE) & 0xFFFF))
        self._sent.append((number, packets))
        self._put(packets if sent.link is None else sent.link(self._frames, packets))
        self._frames += 1

    def _put(self, packets: Iterable[bytes]) -> None:
        port = self._registers.get(protocol.STREAM_PORT) & 0xFFFF
        host = socket.inet_ntoa(struct.pack(">I", self._registers.get(protocol.STREAM_ADDRESS)))
        for packet in packets:
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
        raise DeviceError(f"the GigE Vision camera cannot be opened on {host}: {error.strerror}") from error
    return made


def _pack(lines: NDArray[Any], bits: int, code: int) -> bytes:
    """Lines as the pixel format has them (unpacked ones only)."""
    want, stored = next((want, stored) for at, want, stored in PIXEL_FORMATS.values() if at == code)
    values = lines >> (bits - want) if bits > want else lines << (want - bits)
    return values.astype("<u2" if stored == 16 else "u1").tobytes()
