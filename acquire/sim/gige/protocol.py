"""The GigE Vision packets that a camera needs: bytes in and bytes out, without sockets.

::

    GVCP   control, UDP port 3956     42 flags command length id │ body        (big-endian)
           answers                    status command length id   │ body
    GVSP   lines, UDP                 status block id │ format packet id │ leader, payload or trailer
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

PORT = 3956  # GVCP's, the protocol of commands
KEY = 0x42  # first byte of every command
IP_AND_UDP_BYTES = 20 + 8
"""Bytes of IP and UDP headers, which count towards the packet size that the host sets, as GVSP's own do."""

LEAST_PAYLOAD_BYTES = 64

DEVICE_MODE, MAC, ADDRESS = 0x0004, 0x0008, 0x0024
VENDOR, MODEL, FIRMWARE, SERIAL, XML_URL = 0x0048, 0x0068, 0x0088, 0x00D8, 0x0200
DISCOVERY_BYTES = 0xF8  # the answer to DISCOVERY has the registers below this one
STREAM_CHANNELS, CAPABILITY, HEARTBEAT_MS, TICK_HIGH, TICK_LOW = 0x0904, 0x0934, 0x0938, 0x093C, 0x0940
PRIVILEGE, STREAM_PORT, PACKET_SIZE, STREAM_ADDRESS = 0x0A00, 0x0D00, 0x0D04, 0x0D18
BOOTSTRAP_BYTES = 0x1_0000
"""End of the standard's registers; the camera's own begin here."""

_HEADER = struct.Struct(">BBHHH")
_ANSWER = struct.Struct(">HHHH")
_GVSP = struct.Struct(">HHI")
_GVSP_EXTENDED = struct.Struct(">HHIQI")
_EXTENDED = 0x8000_0000  # flag of a header whose frame id has 64 bits
_EXTENDED_REQUEST = 0x10  # flag of a resend request whose frame id has 64 bits
_RESENDS = 1 << 2  # bit of CAPABILITY: lost packets can be requested again
# reserved, payload type, time stamp, pixel format, width, height, offsets, padding of lines and of the frame
_LEADER = struct.Struct(">HHQIIIIIHH")
_TRAILER = struct.Struct(">HHI")
_IMAGE = 1  # payload type


class GvcpStatus(IntEnum):
    """Why a command was not carried out, in its answer."""

    DONE = 0
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003


class GvcpCommand(IntEnum):
    DISCOVERY = 0x0002
    RESEND = 0x0040
    READ_REGISTER = 0x0080
    WRITE_REGISTER = 0x0082
    READ_MEMORY = 0x0084
    WRITE_MEMORY = 0x0086


@dataclass(frozen=True, slots=True)
class Request:
    """A command as received."""

    command: int
    number: int
    body: bytes
    flags: int = 0


def parse(packet: bytes) -> Request | None:
    """Decode a GVCP command; return None for any other packet."""
    if len(packet) < _HEADER.size:
        return None
    key, flags, command, length, number = _HEADER.unpack_from(packet)
    # One that was cut off on its way gets no answer, and is sent again.
    body = packet[_HEADER.size : _HEADER.size + length]
    return Request(command, number, body, flags) if key == KEY and len(body) == length else None


def parse_resend(request: Request) -> tuple[int, int, int] | None:
    """Return the number of the frame, and the first and last packet to send again; None if it is cut off."""
    try:
        if request.flags & _EXTENDED_REQUEST:
            first, last, number = struct.unpack(">4xIIQ", request.body[:20])
        else:
            number, first, last = struct.unpack(">III", request.body[:12])
    except struct.error:
        return None
    # packet ids have 24 bits
    return number, first & 0xFF_FFFF, last & 0xFF_FFFF


def answer(request: Request, body: bytes, status: GvcpStatus = GvcpStatus.DONE) -> bytes:
    """Return the acknowledge of a request."""
    # an acknowledge has the number after its command's
    return _ANSWER.pack(status, request.command + 1, len(body), request.number) + body


class Registers:
    """The camera's address space, and the control commands that act on it."""

    def __init__(self, space: bytes, texts: dict[int, str], address: bytes) -> None:
        self.memory = bytearray(BOOTSTRAP_BYTES) + bytearray(space)
        for at, text in texts.items():
            self.memory[at : at + len(text)] = text.encode()
        # in network byte order, like the standard's numbers
        self.memory[ADDRESS : ADDRESS + 4] = address
        # A host has to be heard every 3 s unless it sets another time: the standard's own default.
        # Version 1.0 of the standard, big-endian, one stream; time stamps of 10⁹ ticks per second are in ns.
        numbers = {0: 0x1_0000, DEVICE_MODE: 0x8000_0000, STREAM_CHANNELS: 1, HEARTBEAT_MS: 3000}
        # Packets of 1400 bytes fit into the 1500 of an Ethernet frame, should a host not ask for others.
        numbers |= {CAPABILITY: _RESENDS, TICK_LOW: 1_000_000_000, PACKET_SIZE: 1400}
        for at, value in numbers.items():
            self.set(at, value)

    def get(self, at: int) -> int:
        """Return the 32-bit register at an address."""
        value: int = struct.unpack_from(">I", self.memory, at)[0]
        return value

    def set(self, at: int, value: int) -> None:
        """Set the 32-bit register at an address."""
        struct.pack_into(">I", self.memory, at, value)

    def handle(self, request: Request) -> bytes | None:
        """Carry out a command and return its answer; None if it is not supported."""
        try:
            match request.command:
                case GvcpCommand.DISCOVERY:
                    body = bytes(self.memory[:DISCOVERY_BYTES])
                case GvcpCommand.READ_REGISTER:
                    (at,) = struct.unpack(">I", request.body[:4])
                    body = bytes(self.memory[self._place(at, 4)])
                case GvcpCommand.WRITE_REGISTER:
                    at, value = struct.unpack(">II", request.body[:8])
                    self.memory[self._place(at, 4)] = struct.pack(">I", value)
                    # By the standard, the number of registers that were written.
                    body = struct.pack(">I", 1)
                case GvcpCommand.READ_MEMORY:
                    at, count = struct.unpack(">IxxH", request.body[:8])
                    body = request.body[:4] + bytes(self.memory[self._place(at, count)])
                case GvcpCommand.WRITE_MEMORY:
                    (at,) = struct.unpack(">I", request.body[:4])
                    data = request.body[4:]
                    self.memory[self._place(at, len(data))] = data
                    body = struct.pack(">I", len(data))
                case _:
                    return None
        except IndexError:
            return answer(request, b"", GvcpStatus.INVALID_ADDRESS)
        except struct.error:  # a body that is too short for its command
            return answer(request, b"", GvcpStatus.INVALID_PARAMETER)
        return answer(request, body)

    def _place(self, at: int, count: int) -> slice:
        """Return the place of ``count`` bytes. Raises IndexError if the camera has none there."""
        if at + count > len(self.memory):
            raise IndexError(at)
        return slice(at, at + count)


@dataclass(frozen=True, slots=True)
class GvspFrame:
    """One block of lines to send. ``number`` is never 0 and has 16 bits, or 64 in ``extended`` headers."""

    number: int
    time_ns: int
    pixel_format: int
    width: int
    height: int
    data: bytes
    extended: bool = False
    offset: int = 0


def packets(frame: GvspFrame, packet_size: int) -> Iterator[bytes]:
    """Yield leader, payload and trailer."""
    size = (_GVSP_EXTENDED if frame.extended else _GVSP).size
    # A host may write any size, also one of packets that hold nothing.
    step = max(LEAST_PAYLOAD_BYTES, packet_size - IP_AND_UDP_BYTES - size)
    leader = (0, _IMAGE, frame.time_ns, frame.pixel_format, frame.width, frame.height, frame.offset, 0, 0, 0)
    # formats of packets: 1 is a leader, 3 payload, 2 a trailer
    yield _header(frame, 1, 0) + _LEADER.pack(*leader)
    count = 0
    for at in range(0, len(frame.data), step):
        count += 1
        yield _header(frame, 3, count) + frame.data[at : at + step]
    yield _header(frame, 2, count + 1) + _TRAILER.pack(0, _IMAGE, frame.height)


def _header(frame: GvspFrame, content: int, packet: int) -> bytes:
    if frame.extended:
        return _GVSP_EXTENDED.pack(0, 0, _EXTENDED | content << 24, frame.number, packet)
    return _GVSP.pack(0, frame.number, content << 24 | packet)
