"""Injected faults at the GenTL producer: each is counted exactly, by cause and where it was."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ramp_sensor import WIDTH, RampOpener, ramp

from acquire.camera.base import CameraLoss, LossCause
from acquire.camera.harvesters import HarvestersCamera, list_cameras
from acquire.camera.settings import Setting
from acquire.camera.spec import GenicamSpec
from acquire.errors import CameraError, CameraLostError, PlaceError, UsageError
from acquire.lines import LineFlag
from acquire.sim.gentl import layout
from acquire.sim.gentl.bench import GentlBench
from acquire.sim.gentl.build import build
from acquire.sim.gentl.memory import CameraMemory
from acquire.sim.gentl.models import CameraModel

pytestmark = pytest.mark.needs_compiler

HEIGHT = 40
RATE_HZ = 20_000.0
WAIT_S = 300.0
MODELS = {
    "64": CameraModel("SIM-64", WIDTH, line_rate_hz=RATE_HZ),
    "8": CameraModel("SIM-8", WIDTH, line_rate_hz=RATE_HZ, id_bits=8, row_padding=3),
    "8-skips-0": CameraModel("SIM-8-1", WIDTH, line_rate_hz=RATE_HZ, id_bits=8, id_first=1),
}


@pytest.fixture(scope="module")
def bench() -> Iterator[GentlBench]:
    with GentlBench(dict.fromkeys(MODELS.values(), RampOpener(RATE_HZ))) as made:
        yield made


@pytest.fixture
def open_camera(bench: GentlBench) -> Iterator[Callable[..., HarvestersCamera]]:
    opened: list[HarvestersCamera] = []

    def open_one(which: str = "64", *settings: Setting, **changes: Any) -> HarvestersCamera:
        given = {"line_rate_hz": RATE_HZ, "cti": str(bench.cti), "pixels": WIDTH, **changes}
        height = Setting("stream", "BufferHeight", HEIGHT)
        camera = HarvestersCamera(GenicamSpec(MODELS[which].serial, settings=(height, *settings), **given))
        opened.append(camera)
        return camera

    yield open_one
    for camera in opened:
        camera.close()


def memory_of(bench: GentlBench, which: str = "64") -> CameraMemory:
    return bench.cameras[MODELS[which].serial]


class Take:
    """Blocks of a camera as one stream: every line checked against the sensor's, losses with their places."""

    def __init__(self, camera: HarvestersCamera) -> None:
        self.camera = camera
        self.next_line = 0
        self.losses: list[tuple[int, CameraLoss]] = []
        self.flagged: list[tuple[int, int]] = []
        self.lines = 0

    def until(self, line: int) -> Take:
        deadline = time.monotonic() + WAIT_S
        while self.next_line < line:
            assert time.monotonic() < deadline, f"at line {self.next_line} of {line}"
            block = self.camera.next_block(0.2)
            if block is None:
                continue
            at = self.next_line
            for loss in block.losses:
                self.losses.append((at, loss))
                at += loss.count
            assert at == block.first_line
            if block.flags.any():
                assert set(block.flags) == {LineFlag.INCOMPLETE}
                self.flagged.append((block.first_line, len(block.flags)))
            else:
                lines = np.arange(block.first_line, block.first_line + len(block.flags))
                np.testing.assert_array_equal(block.pixels, ramp(lines))
            self.lines += len(block.flags)
            self.next_line = block.first_line + len(block.flags)
            self.camera.release(block)
        return self


FAULTS = {
    "bad": ("BAD", 5, 1, [], [(200, 40)]),
    "short": ("SHORT", 5, 13, [(213, CameraLoss(LossCause.INCOMPLETE, 27))], [(200, 13)]),
    "dropped": ("DROP", 5, 2, [(200, CameraLoss(LossCause.ID_GAP, 80))], []),
    "the first frame": ("DROP", 0, 1, [(0, CameraLoss(LossCause.ID_GAP, 40))], []),
    "over-run": ("OVERRUN", 5, 3, [(200, CameraLoss(LossCause.NO_BUFFER, 120))], []),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_counted_exactly_and_located(bench: GentlBench, open_camera: Any, name: str) -> None:
    kind, frame, count, losses, flagged = FAULTS[name]
    camera = open_camera(frame_id_first=0)
    memory_of(bench).inject(kind, frame, count)
    camera.arm()
    take = Take(camera).until(1000)
    assert (take.losses, take.flagged) == (losses, flagged)
    lost = sum(loss.count for _, loss in losses)
    assert camera.statistics() == {
        "lines": 1000 - lost + (take.next_line - 1000),
        "lost": lost,
        "incomplete_frames": len(flagged),
        "stale_frames": 0,
    }


def test_missed_triggers_are_counted_and_the_frame_they_were_in_is_not_trusted(
    bench: GentlBench, open_camera: Any
) -> None:
    camera = open_camera("64", Setting("remote", "CounterEventSource", "LineTriggerMissed"))
    memory_of(bench).inject("MISSED", 410, 3)
    camera.arm()
    take = Take(camera).until(2000)
    (at, loss), *more = take.losses
    assert (loss, more) == (CameraLoss(LossCause.MISSED_TRIGGER, 3), [])
    assert at == 440, "frame 10 holds lines 400-409 and 413-442"
    assert 400 in [first for first, _ in take.flagged]


def test_faults_after_one_another_are_told_apart(bench: GentlBench, open_camera: Any) -> None:
    memory, camera = memory_of(bench), open_camera()
    for kind, frame, count in (("DROP", 3, 1), ("OVERRUN", 9, 2), ("BAD", 14, 1), ("SHORT", 20, 39)):
        memory.inject(kind, frame, count)
    camera.arm()
    take = Take(camera).until(40 * HEIGHT)
    assert take.losses == [
        (120, CameraLoss(LossCause.ID_GAP, 40)),
        (360, CameraLoss(LossCause.NO_BUFFER, 80)),
        (839, CameraLoss(LossCause.INCOMPLETE, 1)),
    ]
    assert take.flagged == [(560, 40), (800, 39)]


@pytest.mark.parametrize("which", ["64", "8", "8-skips-0"])
def test_incomplete_frames_with_the_ids_of_earlier_ones_are_no_wrap(
    bench: GentlBench, open_camera: Any, which: str
) -> None:
    """Every buffer has been filled before, and ids of 8 bits wrap among the incomplete frames."""
    memory, camera = memory_of(bench, which), open_camera(which)
    for kind, frame in (
        ("BAD", 254),
        ("BAD", 255),
        ("SHORT", 256),
        ("BAD", 300),
        ("DROP", 301),
        ("BAD", 310),
    ):
        memory.inject(kind, frame, 1)
    camera.arm()
    take = Take(camera).until(320 * HEIGHT)
    assert take.losses == [
        (256 * HEIGHT + 1, CameraLoss(LossCause.INCOMPLETE, HEIGHT - 1)),
        (300 * HEIGHT, CameraLoss(LossCause.INCOMPLETE, HEIGHT)),
        (301 * HEIGHT, CameraLoss(LossCause.ID_GAP, HEIGHT)),
    ]
    assert [first // HEIGHT for first, _ in take.flagged] == [254, 255, 256, 310]


@pytest.mark.parametrize("which", ["8", "8-skips-0"])
def test_frame_ids_that_wrap_are_no_loss_and_a_loss_at_the_wrap_is_one(
    bench: GentlBench, open_camera: Any, which: str
) -> None:
    camera = open_camera(which)
    memory_of(bench, which).inject("DROP", 254, 4)
    camera.arm()
    take = Take(camera).until(300 * HEIGHT)
    assert take.losses == [(254 * HEIGHT, CameraLoss(LossCause.ID_GAP, 4 * HEIGHT))]


def test_a_reader_that_is_late_loses_frames_for_want_of_buffers(open_camera: Any) -> None:
    camera = open_camera(line_rate_hz=1.0)  # so few buffers that 40 ms fill them
    camera.arm()
    stream = camera._stream
    deadline = time.monotonic() + WAIT_S
    while not stream.num_underrun:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    take = Take(camera).until(16 * HEIGHT + 400)
    assert {loss.cause for _, loss in take.losses} == {LossCause.NO_BUFFER}
    assert take.losses[0][0] == 16 * HEIGHT, "sixteen buffers were announced, and filled"


def test_a_device_that_is_gone_is_reported_at_once_and_can_be_opened_again(
    bench: GentlBench, open_camera: Any
) -> None:
    memory, camera = memory_of(bench), open_camera()
    camera.arm()
    Take(camera).until(400)
    memory.unplug()
    begin = time.monotonic()
    with pytest.raises(CameraLostError, match="SIM-64 is gone"):
        drain(camera)
    assert time.monotonic() - begin < 60
    camera.close()
    with pytest.raises(CameraError, match="no camera with serial number 'SIM-64'"):
        open_camera()
    memory.plug()
    again = open_camera()
    again.arm()
    assert Take(again).until(400).losses == []


def drain(camera: HarvestersCamera) -> None:
    while (block := camera.next_block(1.0)) is not None:
        camera.release(block)


def test_a_device_that_was_away_in_between_is_gone_all_the_same(bench: GentlBench, open_camera: Any) -> None:
    memory, camera = memory_of(bench), open_camera()
    camera.arm()
    memory.unplug()
    memory.plug()
    with pytest.raises(CameraLostError):
        drain(camera)


def test_a_camera_in_use_is_listed_so_and_refused(bench: GentlBench, open_camera: Any) -> None:
    found = {camera.serial: camera for camera in list_cameras(str(bench.cti))}
    assert sorted(found) == ["SIM-64", "SIM-8", "SIM-8-1"]
    assert {camera.access for camera in found.values()} == {"free"}
    assert {camera.model for camera in found.values()} == {"simulated TDI line-scan camera"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"model": "VT-4K5C-H100"}, "is a 'simulated TDI line-scan camera', not a 'VT-4K5C-H100'"),
        ({"pixels": 32}, "delivers lines of 48 pixels; possible: 32"),
        ({"bits": 8}, "Mono12 of 12 bits; possible: 8 bits"),
        ({"serial": "NONE"}, "no camera with serial number 'NONE'; possible: SIM-64"),
        ({"cti": "/nowhere/x.cti"}, "no such file"),
    ],
)
def test_a_camera_other_than_the_requested_one_is_refused_before_arming(
    bench: GentlBench, changes: dict[str, Any], words: str
) -> None:
    given = {"serial": "SIM-64", "cti": str(bench.cti), **changes}
    with pytest.raises(CameraError, match=words.replace("(", r"\(")):
        HarvestersCamera(GenicamSpec(**given))


def test_a_thousand_starts_are_as_good_as_one(open_camera: Any) -> None:
    """Memory and descriptors after many cycles are those after few. The benchmark takes a thousand."""
    import psutil

    process, camera = psutil.Process(), open_camera(line_rate_hz=RATE_HZ)
    for _ in range(20):
        camera.arm()
        camera.disarm()
    before = process.memory_info().rss, process.num_fds(), process.num_threads()
    for _ in range(80):
        camera.arm()
        camera.disarm()
    after = process.memory_info().rss, process.num_fds(), process.num_threads()
    assert after[1:] == before[1:]
    assert after[0] - before[0] < 4 << 20


@pytest.mark.parametrize("serial", ["", "a/b", "nul\0", "x" * 64, "é" * 32])
def test_a_serial_that_cannot_name_a_file_is_refused(serial: str) -> None:
    with pytest.raises(UsageError, match="possible: 1 to 63 bytes without a slash"):
        GentlBench({CameraModel(serial, WIDTH): RampOpener(RATE_HZ)})


LOOK = """
import ctypes, sys
producer, card = ctypes.CDLL(sys.argv[1]), ctypes.c_void_p()
assert producer.GCInitLib() == 0 and producer.TLOpen(ctypes.byref(card)) == 0
assert producer.TLOpenInterface(card, b"card0", ctypes.byref(card)) == 0
print(flush=True)
kind, access, size = ctypes.c_int32(), ctypes.c_int32(), ctypes.c_size_t(4)
while True:
    producer.IFGetDeviceInfo(card, b"SIM-64", 5, *map(ctypes.byref, (kind, access, size)))
"""


def test_a_camera_can_be_opened_while_others_look_at_it(bench: GentlBench) -> None:
    """Whoever asked whether a camera is free held it for that moment, so that nobody could open it."""
    producer = ctypes.CDLL(str(bench.cti))
    system, card, camera = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
    assert producer.GCInitLib() == producer.TLOpen(ctypes.byref(system)) == 0
    assert producer.TLOpenInterface(system, b"card0", ctypes.byref(card)) == 0
    looking = subprocess.Popen([sys.executable, "-c", LOOK, str(bench.cti)], stdout=subprocess.PIPE)
    try:
        assert looking.stdout is not None
        assert looking.stdout.readline()
        for _ in range(10_000):
            assert producer.IFOpenDevice(card, b"SIM-64", 4, ctypes.byref(camera)) == 0
            assert producer.DevClose(camera) == 0
    finally:
        looking.kill()
        looking.communicate()
        assert producer.IFClose(card) == producer.TLClose(system) == producer.GCCloseLib() == 0


class Raw:
    """A camera through the producer's own functions, as a host that restarts it without its stream."""

    def __init__(self, cti: Path, serial: str) -> None:
        self.producer = ctypes.CDLL(str(cti))
        self.system, self.card, self.device, self.remote, self.stream, self.event = (
            ctypes.c_void_p() for _ in range(6)
        )
        self.call("GCInitLib")
        self.call("TLOpen", ctypes.byref(self.system))
        self.call("TLOpenInterface", self.system, b"card0", ctypes.byref(self.card))
        self.call("IFOpenDevice", self.card, serial.encode(), 4, ctypes.byref(self.device))
        self.call("DevGetPort", self.device, ctypes.byref(self.remote))
        self.call("DevOpenDataStream", self.device, b"Stream0", ctypes.byref(self.stream))
        self.call("GCRegisterEvent", self.stream, 1, ctypes.byref(self.event))

    def call(self, name: str, *arguments: Any) -> None:
        assert getattr(self.producer, name)(*arguments) == 0, name

    def set(self, port: ctypes.c_void_p, name: str, value: int) -> None:
        at, word = ctypes.c_uint64(layout.REGISTERS[name]), ctypes.c_uint64(value)
        self.call("GCWritePort", port, at, ctypes.byref(word), ctypes.byref(ctypes.c_size_t(8)))

    def start(self, buffers: int, size: int) -> None:
        for _ in range(buffers):
            buffer = ctypes.c_void_p()
            self.call(
                "DSAllocAndAnnounceBuffer", self.stream, ctypes.c_size_t(size), None, ctypes.byref(buffer)
            )
            self.call("DSQueueBuffer", self.stream, buffer)
        self.call("DSStartAcquisition", self.stream, 0, ctypes.c_uint64(0))
        self.set(self.remote, "AcquisitionStart", 1)

    def frame(self) -> dict[str, int]:
        """Facts of the next frame, whose buffer is queued again."""
        data, size = (ctypes.c_void_p * 2)(), ctypes.c_size_t(16)
        self.call("EventGetData", self.event, data, ctypes.byref(size), ctypes.c_uint64(60_000))
        found = {}
        for name, info in (("time_ns", 3), ("offset", 12), ("id", 16)):
            value = ctypes.c_uint64()
            arguments = ctypes.c_int32(), value, ctypes.c_size_t(8)
            self.call(
                "DSGetBufferInfo", self.stream, ctypes.c_void_p(data[0]), info, *map(ctypes.byref, arguments)
            )
            found[name] = value.value
        self.call("DSQueueBuffer", self.stream, ctypes.c_void_p(data[0]))
        return found

    def close(self) -> None:
        self.call("DevClose", self.device)
        self.call("IFClose", self.card)
        self.call("TLClose", self.system)
        self.call("GCCloseLib")


def test_a_camera_that_is_started_again_delivers_no_line_of_before() -> None:
    """The stream had not taken them all yet, and the first frame after the start was of before."""
    width = 2048
    model = CameraModel("SIM-R", width, line_rate_hz=50_000.0)
    with GentlBench({model: RampOpener(50_000.0, width=width)}) as bench:
        raw = Raw(bench.cti, model.serial)
        try:
            raw.set(raw.remote, "PixelFormat", layout.PIXEL_FORMATS["Mono10p"][0])  # slow to pack
            raw.set(raw.remote, "Width", width - 8)
            raw.set(raw.remote, "OffsetX", 8)
            raw.start(8, 256 * width * 2)
            assert raw.frame()["id"] == 0
            memory = bench.cameras[model.serial]
            for _ in range(3):
                deadline = time.monotonic() + WAIT_S
                while memory["HEAD"] - memory["TAIL"] < 500:
                    assert time.monotonic() < deadline, "the stream is too fast to be behind"
                    assert raw.frame()["offset"] == 8
                raw.set(raw.remote, "AcquisitionStop", 1)
                started_ns = time.monotonic_ns()
                raw.set(raw.remote, "AcquisitionStart", 1)
                while (frame := raw.frame())["id"]:
                    pass
                assert frame["time_ns"] > started_ns
        finally:
            raw.close()


def test_a_cache_that_cannot_be_written_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "cache").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(PlaceError, match=r"cache/tdi-acquire cannot be written: .*XDG_CACHE_HOME"):
        build()
