"""One suite for every way to a camera: in this process, through our GenTL producer and a foreign one, through
Aravis and GigE Vision.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from gige_helpers import aravis_camera

from acquire.camera.aravis import FAKE, AravisOpener
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
from acquire.testing.cameras import CameraContract, CameraStand

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


def simulated_stand(way: str) -> Iterator[CameraStand]:
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
            yield CameraStand(opener, start, wire.stop, "SIM-A", lines)
        finally:
            server.end(time.monotonic() + WAIT_S)
    elif way == "gentl":
        model = CameraModel("SIM-A", STAGES, row_padding=5, id_bits=16, id_first=1)
        with GentlBench({model: sensor}) as bench:
            gentl = HarvestersOpener(spec_of(rig, "a", str(bench.cti)))
            yield CameraStand(gentl, start, wire.stop, "SIM-A", lines)
    else:
        yield CameraStand(sensor, start, wire.stop, "SIM-A", lines, sent=optics)
    wire.close()


def foreign_stand() -> Iterator[CameraStand]:
    """The producer in the genicam wheel: an area camera that runs freely and shows its own pictures."""
    import genicam

    cti = str(Path(genicam.__file__).with_name("viky.cti"))
    settings = (Setting("remote", "PixelFormat", "Mono8"),)
    opener = HarvestersOpener(GenicamSpec("", settings=settings, cti=cti, bits=8))
    nothing = lambda: None  # noqa: E731
    yield CameraStand(opener, nothing, nothing)


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


def aravis_stand(serial: str, interface: str = "") -> Iterator[CameraStand]:
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
    yield CameraStand(opener, nothing, nothing, serial)


def gige_stand(log: Path) -> Iterator[CameraStand]:
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
def stand(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CameraStand]:
    makers = {
        "in process": lambda: simulated_stand("in process"),
        "our producer": lambda: simulated_stand("gentl"),
        "foreign producer": foreign_stand,
        "our GigE camera": lambda: simulated_stand("gige"),
        "Aravis' fake camera": lambda: aravis_stand("1", FAKE),
        "Aravis' GigE camera": lambda: gige_stand(tmp_path_factory.mktemp("aravis") / "log"),
    }
    yield from makers[request.param]()


class TestCameras(CameraContract):
    """Every way that is ours."""
