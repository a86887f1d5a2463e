"""The simulated GigE Vision camera, controlled and watched packet by packet, without a host's library."""

from __future__ import annotations

import itertools
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from acquire.camera.base import CameraBlock
from acquire.sim.gentl.layout import PIXEL_FORMATS, REGISTERS
from acquire.sim.gentl.models import CameraModel
from acquire.sim.gige import protocol
from acquire.sim.gige.camera import GigeCamera, Transmission

WIDTH, HEIGHT, BLOCK = 8, 5, 7
LOST = {9, 10, 11, 30}
LINE_NS = 50_000


class LossySensor:
    """Every pixel states the number of its line; some lines are lost, and blocks end before them."""

    def arm(self) -> None:
        self.next_line = 0

    def disarm(self) -> None:
        """Nothing to do."""

    def next_block(self, timeout_s: float) -> CameraBlock:
        while self.next_line in LOST:
            self.next_line += 1
        first = self.next_line
        while self.next_line - first < BLOCK and self.next_line not in LOST:
            self.next_line += 1
        lines = np.arange(first, self.next_line)
        pixels = np.repeat(lines[:, None], WIDTH, axis=1).astype(np.uint16)
        return CameraBlock(first, pixels, np.zeros(len(lines), np.uint16))

    def times_ns(self, first_line: int, count: int) -> np.ndarray:
        return np.arange(first_line, first_line + count) * LINE_NS


class Tap:
    """Takes the packets of every frame from the link."""

    def __init__(self) -> None:
        self.frames: list[list[bytes]] = []

    def __call__(self, frame: int, packets: list[bytes]) -> list[bytes]:
        self.frames.append(packets)
        return []


_numbers = itertools.count(1)


def ask(
    host: socket.socket, camera: GigeCamera, address: str, command: int, body: bytes
) -> tuple[int, bytes]:
    """Send a command as a host does; return the status and the body of the answer."""
    number = next(_numbers)
    host.sendto(
        struct.pack(">BBHHH", protocol.KEY, 1, command, len(body), number) + body, (address, protocol.PORT)
    )
    camera.turn()
    reply = host.recv(1024)
    status, answered, length, of = struct.unpack_from(">HHHH", reply)
    assert (answered, of, length) == (command + 1, number, len(reply) - 8)
    return status, reply[8:]


def write(host: socket.socket, camera: GigeCamera, address: str, name: str, value: int) -> int:
    body = struct.pack(">I", protocol.BOOTSTRAP_BYTES + REGISTERS[name]) + struct.pack("<Q", value)
    return ask(host, camera, address, protocol.GvcpCommand.WRITE_MEMORY, body)[0]


def read(host: socket.socket, camera: GigeCamera, address: str, name: str) -> int:
    body = struct.pack(">IHH", protocol.BOOTSTRAP_BYTES + REGISTERS[name], 0, 8)
    status, answer = ask(host, camera, address, protocol.GvcpCommand.READ_MEMORY, body)
    assert status == 0
    return struct.unpack_from("<Q", answer, 4)[0]


@contextmanager
def bench(at: int, tap: Tap, width: int = WIDTH) -> Iterator[tuple[socket.socket, GigeCamera, str]]:
    address = f"127.{1 + os.getpid() // 256 % 254}.{os.getpid() % 256}.{at}"
    model = CameraModel("OURS", width, pixel_format="Mono12")
    with (
        GigeCamera(model, LossySensor(), address, Transmission(link=tap)) as camera,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as host,
    ):
        host.settimeout(60)
        yield host, camera, address


BAD_VALUES = [("PixelFormat", 12345), ("PixelFormat", PIXEL_FORMATS["Mono12p"][0])]
BAD_VALUES += [("Width", 0), ("Width", WIDTH + 1), ("OffsetX", 1), ("Height", 0)]


def test_values_that_no_line_can_be_sent_with_are_refused_and_change_nothing() -> None:
    """One of them ended the camera's process, another left it in an endless loop."""
    tap = Tap()
    with bench(41, tap) as (host, camera, address):
        for name, value in BAD_VALUES:
            before = read(host, camera, address, name)
            assert write(host, camera, address, name, value) == protocol.GvcpStatus.INVALID_PARAMETER
            assert read(host, camera, address, name) == before
        beyond = struct.pack(">IHH", 1 << 30, 0, 8)
        for command, body, status in (
            (protocol.GvcpCommand.READ_MEMORY, beyond, protocol.GvcpStatus.INVALID_ADDRESS),
            (protocol.GvcpCommand.WRITE_MEMORY, beyond, protocol.GvcpStatus.INVALID_ADDRESS),
            (protocol.GvcpCommand.READ_REGISTER, beyond[:4], protocol.GvcpStatus.INVALID_ADDRESS),
            (protocol.GvcpCommand.WRITE_REGISTER, beyond, protocol.GvcpStatus.INVALID_ADDRESS),
            (protocol.GvcpCommand.WRITE_REGISTER, b"", protocol.GvcpStatus.INVALID_PARAMETER),
        ):
            assert ask(host, camera, address, command, body) == (status, b"")
        assert write(host, camera, address, "Height", HEIGHT) == 0
        assert write(host, camera, address, "AcquisitionStart", 1) == 0
        while not tap.frames:
            camera.turn()


def test_a_request_that_is_cut_off_and_packets_without_room_do_not_end_the_camera() -> None:
    tap = Tap()
    with bench(43, tap) as (host, camera, address):
        for flags in (1, 0x11):  # frame ids of 16 bits, and of 64
            packet = struct.pack(">BBHHH", protocol.KEY, flags, protocol.GvcpCommand.RESEND, 4, 1) + bytes(4)
            host.sendto(packet, (address, protocol.PORT))
            camera.turn()
        size = struct.pack(">II", protocol.PACKET_SIZE, protocol.IP_AND_UDP_BYTES + 8)
        assert ask(host, camera, address, protocol.GvcpCommand.WRITE_REGISTER, size)[0] == 0
        assert write(host, camera, address, "Height", HEIGHT) == 0
        assert write(host, camera, address, "AcquisitionStart", 1) == 0
        while not tap.frames:
            camera.turn()


def test_a_frame_states_the_column_at_which_its_lines_begin() -> None:
    tap = Tap()
    with bench(42, tap) as (host, camera, address):
        for name, value in (("Width", 4), ("OffsetX", 3), ("Height", HEIGHT), ("AcquisitionStart", 1)):
            assert write(host, camera, address, name, value) == 0
        while not tap.frames:
            camera.turn()
    _, _, _, _, width, height, offset, *_ = struct.unpack_from(">HHQIIIIIHH", tap.frames[0][0], 8)
    assert (width, height, offset) == (4, HEIGHT, 3)


def test_frames_have_the_time_of_their_first_line_also_after_lost_lines() -> None:
    tap = Tap()
    with bench(40, tap) as (host, camera, address):
        for name, value in (("Width", WIDTH), ("Height", HEIGHT), ("AcquisitionStart", 1)):
            assert write(host, camera, address, name, value) == 0
        while len(tap.frames) < 12:
            camera.turn()
    seen: list[int] = []
    for leader, *payload, _ in tap.frames:
        (time_ns,) = struct.unpack_from(">Q", leader, 8 + 4)
        data = b"".join(packet[8:] for packet in payload)
        lines = np.frombuffer(data, "<u2").reshape(HEIGHT, WIDTH)[:, 0].tolist()
        assert time_ns == lines[0] * LINE_NS
        seen += lines
    assert seen == [line for line in range(seen[-1] + 1) if line not in LOST]
