"""One suite for every way to a camera: in this process, through our GenTL producer and a foreign one, through
Aravis and GigE Vision.
"""

from __future__ import annotations

import itertools
import pickle
import signal
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from gige_helpers import aravis_camera

from acquire.camera.aravis import FAKE, AravisOpener
from acquire.camera.base import Camera, CameraBlock
from acquire.camera.harvesters import HarvestersOpener
from acquire.camera.settings import Setting
from acquire.camera.spec import GenicamSpec, spec_of
from acquire.config import load_rig, load_scene
from acquire.errors import CameraError
from acquire.processes.messages import Ready
from acquire.processes.worker import Worker
from acquire.sim.clock import Wire
from acquire.sim.devices import SimulatedCameraOpener, SimulatedOptics
from acquire.sim.gentl.bench import GentlBench
from acquire.sim.gentl.models import CameraModel
from acquire.sim.gige.arms import address_of
from acquire.sim.gige.camera import serve
from acquire.sim.lines import StreamingArm
from acquire.sim.scenes import build_scene

WAIT_S = 300.0
STAGES, BLOCK = 16, 32
LINE_NS = 30_000
OVERRIDES = {
    "geometry.stages": STAGES,
    "stream.block_lines": BLOCK,
    "cameras.a.frame_id_first": 1,
    **{
        f"cameras.{arm}.settings": [
            ["remote", "Width", STAGES],
            ["remote", "PixelFormat", "Mono12p"],
            ["stream", "BufferHeight", BLOCK],
        ]
        for arm in "ab"
    },
}


@dataclass
class Stand:
    """A way to a camera, its trigger, and what its lines must be; None: they are not ours to know."""

    open: Callable[[], Camera]
    start: Callable[[], object]
    stop: Callable[[], object]
    lines: Callable[[int, int], np.ndarray] | None
    opener: object
    serial: str


def simulated_stand(way: str) -> Iterator[Stand]:
    rig = load_rig("rig-demo-gentl", OVERRIDES)
    optics = SimulatedOptics("a", rig.geometry, load_scene(rig.simulation.scene))
    wire, code = Wire(), rig.code.build()
    sensor = SimulatedCameraOpener(wire, optics, rig.cameras.a, BLOCK, rig.line_rate_hz)
    S = rig.geometry.substeps
    scene = build_scene(optics.scene, STAGES * S, LINE_NS * 1e-9 / S)
    sensed = StreamingArm(scene, code, STAGES, S, "a")
    start = lambda: wire.start(Fraction(LINE_NS), Fraction(1), code.to_attrs())  # noqa: E731

    def lines(first: int, count: int) -> np.ndarray:
        light = sensed.lines(first - STAGES - 1, count)
        return np.clip(np.rint(light * np.float32(6.0)), 0, 4095)

    if way == "gige":
        spec = replace(spec_of(rig, "a", address_of("a")), settings=GIGE)
        model = CameraModel("SIM-A", STAGES, pixel_format="Mono12")
        server = Worker("camera", serve, model, sensor, address_of("a"))
        server.expect(Ready, time.monotonic() + WAIT_S)
        opener = AravisOpener(spec)
        opener().close()  # Aravis keeps what its first look at the network made
        try:
            yield Stand(opener, start, wire.stop, lines, spec, "SIM-A")
        finally:
            server.end(time.monotonic() + WAIT_S)
    elif way == "gentl":
        model = CameraModel("SIM-A", STAGES, row_padding=5, id_bits=16, id_first=1)
        with GentlBench({model: sensor}) as bench:
            gentl = HarvestersOpener(spec_of(rig, "a", str(bench.cti)))
            yield Stand(gentl, start, wire.stop, lines, gentl.spec, "SIM-A")
    else:
        yield Stand(sensor, start, wire.stop, lines, optics, "SIM-A")
    wire.close()


def foreign_stand() -> Iterator[Stand]:
    """The producer in the genicam wheel: an area camera that runs freely and shows its own pictures."""
    import genicam

    cti = str(Path(genicam.__file__).with_name("viky.cti"))
    settings = (Setting("remote", "PixelFormat", "Mono8"),)
    opener = HarvestersOpener(GenicamSpec("", settings=settings, cti=cti, bits=8))
    nothing = lambda: None  # noqa: E731
    yield Stand(opener, nothing, nothing, None, opener, "")


GIGE = (
    Setting("remote", "Width", STAGES),
    Setting("remote", "Height", BLOCK),
    Setting("remote", "PixelFormat", "Mono12"),
)
AREA = (
    Setting("remote", "Width", 64),
    Setting("remote", "Height", 16),
    Setting("remote", "PixelFormat", "Mono8"),
)


def aravis_stand(serial: str, interface: str = "") -> Iterator[Stand]:
    """Aravis keeps what its first look at the network made: that look is taken here."""
    opener = AravisOpener(GenicamSpec(serial, settings=AREA, cti=interface, pixels=64, bits=8))
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            opener().close()
            break
        except CameraError:
            assert time.monotonic() < deadline
    nothing = lambda: None  # noqa: E731
    yield Stand(opener, nothing, nothing, None, opener, serial)


def gige_stand(log: Path) -> Iterator[Stand]:
    """Aravis' GigE Vision camera: packets over the loopback interface."""
    with aravis_camera(log) as serial:
        yield from aravis_stand(serial)


@pytest.fixture(
    scope="module",
    params=[
        "in process",
        pytest.param("our producer", marks=pytest.mark.needs_compiler),
        pytest.param("foreign producer", marks=pytest.mark.needs_genicam),
        pytest.param("our GigE camera", marks=pytest.mark.needs_aravis),
        pytest.param("Aravis' fake camera", marks=pytest.mark.needs_aravis),
        pytest.param("Aravis' GigE camera", marks=pytest.mark.needs_gige_camera),
    ],
)
def stand(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    makers = {
        "in process": lambda: simulated_stand("in process"),
        "our producer": lambda: simulated_stand("gentl"),
        "foreign producer": foreign_stand,
        "our GigE camera": lambda: simulated_stand("gige"),
        "Aravis' fake camera": lambda: aravis_stand("1", FAKE),
        "Aravis' GigE camera": lambda: gige_stand(tmp_path_factory.mktemp("aravis") / "log"),
    }
    yield from makers[request.param]()


@pytest.fixture
def camera(stand: Stand) -> Iterator[Camera]:
    opened = stand.open()
    yield opened
    opened.close()
    stand.stop()


def take(camera: Camera, blocks: int) -> list[CameraBlock]:
    """So many blocks, copied and released."""
    found: list[CameraBlock] = []
    deadline = time.monotonic() + WAIT_S
    while len(found) < blocks:
        assert time.monotonic() < deadline, f"{len(found)} of {blocks} blocks came"
        block = camera.next_block(0.2)
        if block is not None:
            found.append(CameraBlock(block.first_line, block.pixels.copy(), block.flags.copy(), block.losses))
            camera.release(block)
    return found


def test_it_says_who_it_is_and_how_it_is_set(stand: Stand, camera: Camera) -> None:
    identity, settings = camera.identify(), camera.settings()
    assert identity.model
    assert stand.serial in identity.serial
    assert settings["Width"] >= 1
    assert settings["PixelFormat"].startswith("Mono")


def test_a_camera_that_is_not_armed_gives_no_lines(camera: Camera) -> None:
    with pytest.raises(CameraError, match="not armed"):
        camera.next_block(0.1)


def test_without_a_trigger_the_wait_is_bounded_and_in_vain(stand: Stand, camera: Camera) -> None:
    camera.arm()
    if stand.lines is not None:
        begin = time.monotonic()
        assert camera.next_block(0.1) is None
        assert time.monotonic() - begin < 60
    camera.disarm()


def test_lines_count_from_arm_without_a_hole_and_are_what_the_sensor_saw(
    stand: Stand, camera: Camera
) -> None:
    camera.arm()
    stand.start()
    blocks = take(camera, 12)
    if stand.lines is not None:
        assert blocks[0].first_line == 0
        expected = stand.lines(0, 12 * len(blocks[0].flags))
        np.testing.assert_array_equal(np.concatenate([block.pixels for block in blocks]), expected)
    for before, after in itertools.pairwise(blocks):
        assert after.first_line == before.first_line + len(before.flags) + sum(
            loss.count for loss in after.losses
        )
    assert all(block.pixels.ndim == 2 and len(block.pixels) == len(block.flags) for block in blocks)
    assert camera.statistics()["lines"] == sum(len(block.flags) for block in blocks)


def test_every_arming_counts_anew_and_ending_twice_is_ending_once(stand: Stand, camera: Camera) -> None:
    for _ in range(2):
        camera.arm()
        stand.start()
        assert take(camera, 2)[0].first_line == 0
        camera.disarm()
        camera.disarm()
        stand.stop()
    camera.close()
    camera.close()


def test_a_closed_camera_can_be_opened_again(stand: Stand) -> None:
    for _ in range(2):
        opened = stand.open()
        opened.arm()
        opened.close()


def test_opening_leaves_signals_and_warnings_as_they_were(stand: Stand) -> None:
    before = signal.getsignal(signal.SIGINT), list(warnings.filters)
    stand.open().close()
    assert (signal.getsignal(signal.SIGINT), list(warnings.filters)) == before


def test_what_opens_it_can_be_given_to_another_process(stand: Stand) -> None:
    assert pickle.loads(pickle.dumps(stand.opener)) == stand.opener
