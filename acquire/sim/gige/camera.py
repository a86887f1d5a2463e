"""The process of a simulated GigE Vision camera, of which there is one per loopback address.

It answers control packets and sends the lines that its sensor reads out, ``Height`` lines at a time. Packets
that the host misses are sent again as long as the camera keeps their frame.
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
    from acquire.sim.gentl.feeder import LineSource

_IDLE_S = 0.01
_BLOCK_WAIT_S = 0.002
_BASE = protocol.BOOTSTRAP_BYTES
_IMAGE_REGISTERS = slice(_BASE + REGISTERS["Width"], _BASE + REGISTERS["PayloadSize"])

_KEPT_FRAMES = 16
"""Number of recent frames whose packets can be sent again."""
Link = Callable[[int, list[bytes]], Iterable[bytes]]
"""Selects the packets of a frame that reach the host, and their order; frames count from 0."""


@dataclass(frozen=True, slots=True)
class Transmission:
    """Numbering of frames, and losses on the link. Picklable if ``link`` is.

    ``first_id`` : first id of every acquisition; ids skip 0. ``extended`` : ids of 64 bits instead of 16.
    ``resends`` : packets are sent again when the host asks for them. ``link`` : None loses nothing.
    """

    first_id: int = 1
    extended: bool = False
    resends: bool = True
    link: Link | None = None

    def frame_id(self, frame: int) -> int:
        """Return the id of a frame; frames count from 0."""
        # 0 is not an image's: the standard reserves it for the packet that tests the path.
        return 1 + (self.first_id - 1 + frame) % (2**64 - 1 if self.extended else 0xFFFF)


def serve(
    mailbox: Mailbox,
    model: CameraModel,
    opener: Callable[[], Any],
    address: str = "127.0.0.1",
    transmission: Transmission = Transmission(),
) -> None:
    """Main function of the camera's process: serve control packets and lines in turn."""
    with GigeCamera(model, opener(), address, transmission) as camera:
        mailbox.post(Ready())
        while True:
            mailbox.take()  # raises when the owner ends the process
            camera.turn()


class GigeCamera:
    """See the module. Raises DeviceError if the address is taken."""

    def __init__(
        self, model: CameraModel, sensor: LineSource, address: str, transmission: Transmission
    ) -> None:
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
        self._sensor, self._bits, self._sensor_width = sensor, model.bits, model.sensor_width
        offered = gige(model).features["PixelFormat"].entries
        self._formats = {PIXEL_FORMATS[name][0]: PIXEL_FORMATS[name][1:] for name in offered}
        self._control = [_bound(address, shared=False), _bound("255.255.255.255", shared=True)]
        self._lines = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._lines.bind((address, 0))
        # sender, request and answer of the last command
        self._answered: tuple[Any, protocol.Request | None, bytes | None] = (None, None, None)
        self._acquiring = False
        self._frames = 0
        self._sent: deque[tuple[int, list[bytes]]] = deque(maxlen=_KEPT_FRAMES)
        self._waiting: list[tuple[NDArray[np.int64], NDArray[Any]]] = []

    def turn(self) -> None:
        """Serve what is due now; wait a moment if there is nothing."""
        # While lines are wanted, the wait is that for the sensor, below.
        ready, _, _ = select.select(self._control, [], [], 0 if self._acquiring else _IDLE_S)
        for control in ready:
            self._answer(control)
        if self._acquiring and (block := self._sensor.next_block(_BLOCK_WAIT_S)) is not None:
            # Every line with its number: the sensor may have lost lines in between.
            numbers = block.first_line + np.arange(len(block.pixels))
            self._waiting.append((numbers, np.array(block.pixels)))
            height = self._register("Height")
            while sum(len(lines) for _, lines in self._waiting) >= height:
                numbers, lines = (np.concatenate(parts) for parts in zip(*self._waiting, strict=True))
                self._send(int(self._sensor.times_ns(int(numbers[0]), 1)[0]), lines[:height])
                self._waiting = [(numbers[height:], lines[height:])] if len(lines) > height else []

    def _answer(self, control: socket.socket) -> None:
        # The standard limits a control packet to 576 bytes.
        packet, sender = control.recvfrom(2048)
        request = protocol.parse(packet)
        if request is None:
            return
        if request.command == protocol.GvcpCommand.RESEND:
            # A request for a frame that is no longer kept gets no answer: the host gives the frame up.
            asked = protocol.parse_resend(request)
            for kept, packets in self._sent if self.transmission.resends else ():
                if asked is not None and kept == asked[0]:
                    self._put(packets[asked[1] : asked[2] + 1])
            return
        # The same request again means that its answer did not arrive in time: only the answer is repeated.
        if (sender, request) != self._answered[:2]:
            before = self._registers.memory[_IMAGE_REGISTERS]
            result = self._registers.handle(request)
            width = self._register("Width")
            # A host need not keep to the description of the registers.
            is_valid = (
                self._register("PixelFormat") in self._formats
                and width > 0
                and self._register("OffsetX") + width <= self._sensor_width
                and self._register("Height") > 0
            )
            if is_valid:
                # Before the answer is sent: the host may start the trigger as soon as it has the answer.
                self._apply_registers()
            else:
                self._registers.memory[_IMAGE_REGISTERS] = before
                result = protocol.answer(request, b"", protocol.GvcpStatus.INVALID_PARAMETER)
            self._answered = (sender, request, result)
        reply = self._answered[2]
        if reply is not None:
            self._control[0].sendto(reply, sender)

    def _apply_registers(self) -> None:
        """Carry out the commands that the host has set in registers; they read back as 0 once done."""
        _, stored = self._formats[self._register("PixelFormat")]
        pixels = self._register("Width") * self._register("Height")
        self._set_register("PayloadSize", pixels * stored // 8)
        for name, wanted in (("AcquisitionStop", False), ("AcquisitionStart", True)):
            if self._register(name):
                self._set_register(name, 0)
                self._acquiring = wanted
                self._waiting.clear()
                # Frames are numbered anew: packets of an earlier acquisition would be sent in their place.
                self._sent.clear()
                self._frames = 0
                if wanted:
                    self._sensor.arm()
                else:
                    self._sensor.disarm()

    def _send(self, time_ns: int, lines: NDArray[Any]) -> None:
        code = self._register("PixelFormat")
        offset, width = self._register("OffsetX"), self._register("Width")
        # Samples as the pixel format stores them; `gige` offers only formats that are not packed.
        significant, stored = self._formats[code]
        samples = lines[:, offset : offset + width]
        excess = self._bits - significant
        # the sensor's most significant bits, as a camera with fewer bits sends them
        samples = samples >> excess if excess > 0 else samples << -excess
        data = samples.astype("<u2" if stored == 16 else "u1").tobytes()
        transmission = self.transmission
        number = transmission.frame_id(self._frames)
        frame = protocol.GvspFrame(
            number=number,
            time_ns=time_ns,
            pixel_format=code,
            width=width,
            height=len(lines),
            data=data,
            extended=transmission.extended,
            offset=offset,
        )
        packets = list(protocol.packets(frame, self._registers.get(protocol.PACKET_SIZE) & 0xFFFF))
        self._sent.append((number, packets))
        self._put(packets if transmission.link is None else transmission.link(self._frames, packets))
        self._frames += 1

    def _put(self, packets: Iterable[bytes]) -> None:
        # the upper half of the register holds other fields of the standard
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
        for each in (*self._control, self._lines):
            each.close()


def _bound(host: str, *, shared: bool) -> socket.socket:
    """Return a control socket; ``shared`` for the broadcast address, on which every camera listens."""
    control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    control.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, shared)
    control.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    try:
        control.bind((host, protocol.PORT))
    except OSError as error:
        control.close()
        raise DeviceError(
            f"the GigE Vision camera cannot be opened on {host}: {error.strerror}",
            hint="another address of this host; a program that uses UDP port 3956 there has to end",
        ) from error
    return control
