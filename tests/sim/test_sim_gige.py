"""The simulated GigE Vision camera, controlled and watched packet by packet, without a host's library."""

from __future__ import annotations

import os
import socket
import struct

import numpy as np

from acquire.camera.base import CameraBlock
from acquire.sim.gentl.layout import REGISTERS
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


def write(host: socket.socket, camera: GigeCamera, address: str, name: str, value: int) -> None:
    """Set a register as a host does, and wait for the answer."""
    body = struct.pack(">I", protocol.BOOTSTRAP_BYTES + REGISTERS[name]) + struct.pack("<Q", value)
    header = struct.pack(">BBHHH", protocol.KEY, 1, protocol.Command.WRITE_MEMORY, len(body), 1)
    host.sendto(header + body, (address, protocol.PORT))
    camera.turn()
    assert host.recv(64)[2:4] == struct.pack(">H", protocol.Command.WRITE_MEMORY + 1)


def test_frames_have_the_time_of_their_first_line_also_after_lost_lines() -> None:
    address, tap = f"127.{1 + os.getpid() // 256 % 254}.{os.getpid() % 256}.40", Tap()
    model = CameraModel("OURS", WIDTH, pixel_format="Mono12")
    with (
        GigeCamera(model, LossySensor(), address, Transmission(link=tap)) as camera,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as host,
    ):
        host.settimeout(60)
        for name, value in (("Width", WIDTH), ("Height", HEIGHT), ("AcquisitionStart", 1)):
            write(host, camera, address, name, value)
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
