"""GigE Vision cameras on the loopback interface: ours in a thread, with a link of the test's, and Aravis'."""

from __future__ import annotations

import itertools
import os
import random
import re
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from left_out import FAKE_GIGE
from ramp_sensor import ramp

from acquire.camera.aravis import AravisCamera
from acquire.camera.base import CameraBlock
from acquire.camera.settings import Setting
from acquire.camera.spec import GenicamSpec
from acquire.errors import CameraError
from acquire.sim.gentl.models import CameraModel
from acquire.sim.gige.camera import GigeCamera, Transmission

WAIT_S = 300.0
WIDTH = 48
_numbers = itertools.count()


@dataclass
class PacedSensor:
    """Every pixel says which line it is of; no line comes before ``allowed``."""

    block: int
    allowed: int = 0
    next_line: int = 0
    armed: threading.Event = field(default_factory=threading.Event)

    def arm(self) -> None:
        self.next_line = 0
        self.armed.set()

    def disarm(self) -> None:
        self.armed.clear()

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        if self.next_line + self.block > self.allowed:
            time.sleep(0.001)
            return None
        lines = np.arange(self.next_line, self.next_line + self.block)
        self.next_line += self.block
        return CameraBlock(int(lines[0]), ramp(lines, WIDTH), np.zeros(self.block, np.uint16))

    def times_ns(self, first_line: int, count: int) -> np.ndarray:
        return 1_000_000_000 + np.arange(first_line, first_line + count) * 50_000


@dataclass(frozen=True)
class BadLink:
    """Loses a ``share`` of the packets; for a camera in a process of its own."""

    share: float

    def __call__(self, frame: int, packets: list[bytes]) -> list[bytes]:
        chance = random.Random(frame)
        return [packet for packet in packets if chance.random() >= self.share]


@contextmanager
def our_camera(height: int, transmission: Transmission, pixel_format: str = "Mono12") -> Iterator[tuple]:
    """Sensor and address of a camera that sends frames of so many lines."""
    pid = os.getpid()
    address = f"127.{1 + pid // 256 % 254}.{pid % 256}.{50 + next(_numbers) % 200}"
    sensor = PacedSensor(height)
    ended = threading.Event()
    model = CameraModel("OURS", WIDTH, pixel_format=pixel_format)
    with GigeCamera(model, sensor, address, transmission) as camera:

        def live() -> None:
            while not ended.is_set():
                camera.turn()

        thread = threading.Thread(target=live)
        thread.start()
        try:
            yield sensor, address
        finally:
            ended.set()
            thread.join(WAIT_S)


def spec_at(address: str, height: int, *settings: Setting, **changes: object) -> GenicamSpec:
    size = (
        Setting("remote", "Width", WIDTH),
        Setting("remote", "Height", height),
        Setting("remote", "PixelFormat", "Mono12"),
    )
    given = {"line_rate_hz": 20_000.0, "cti": address, "settings": size + settings, **changes}
    return GenicamSpec("OURS", **given)


def open_in_time(opener: Callable[[], AravisCamera]) -> AravisCamera:
    """A camera that may have to start first."""
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            return opener()
        except CameraError:
            if time.monotonic() > deadline:
                raise


@contextmanager
def aravis_camera(log: Path, lost_per_thousand: int = 0) -> Iterator[str]:
    """Serial number of Aravis' own camera, whose port others may have; ``log`` is what it sends and drops."""
    serial, deadline = f"GV-{os.getpid()}", time.monotonic() + 300
    command = [
        FAKE_GIGE,
        "-i",
        "127.0.0.1",
        "-s",
        serial,
        "-r",
        str(lost_per_thousand),
        "-d",
        "stream-thread:2",
    ]
    while True:
        with log.open("w") as out, subprocess.Popen(command, stdout=out, stderr=out) as server:
            try:
                server.wait(1.0)
            except subprocess.TimeoutExpired:
                yield serial
                return
            finally:
                server.kill()
        assert time.monotonic() < deadline, "the port was never free"


def sent_and_dropped(log: Path, packets: int) -> dict[int, set[int]]:
    """Frame → which of its packets Aravis' camera did not send; frames count from 0, in order."""
    found: dict[int, set[int]] = {}
    numbers: dict[str, int] = {}
    words = r"(Send|Drop) (?:frame|GVSP (leader|data|trailer) packet frame:) ?(\d+)(?:, block:(\d+))?"
    for what, packet, frame, block in re.findall(words, log.read_text()):
        if what == "Send":
            numbers[frame] = len(found)
            found[numbers[frame]] = set()
        else:
            found[numbers[frame]].add({"leader": 0, "trailer": packets - 1}.get(packet) or int(block or 0))
    return found
