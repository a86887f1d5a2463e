"""Helpers of the simulation's tests; main functions of spawned processes are here, apart from pytest."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.codes import PrbsCode
from acquire.config import GeometryConfig
from acquire.config.device import CameraConfig
from acquire.config.scene import ConstantDrive, SineDrive
from acquire.sim.devices import SimulatedOptics
from acquire.sim.leds import LedConfig, LedSceneConfig
from acquire.trigger.base import TriggerRun

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection

    from acquire.camera.base import Camera, CameraOpener
    from acquire.codes import Code
    from acquire.sim.clock import Wire
    from acquire.sim.scene import Scene

CODE = PrbsCode.from_seed(23, 7)
LEDS = LedSceneConfig(
    kind="leds",
    title="two LEDs",
    leds=(
        LedConfig(
            name="x",
            shape="x",
            row=0.3,
            column=0.35,
            size=0.5,
            drive=SineDrive(waveform="sine", frequency_hz=3700.0, low=0.1, phase_deg=20),
            saturation=0.6,
        ),
        LedConfig(
            name="triangle",
            shape="triangle",
            row=0.6,
            column=0.7,
            size=0.55,
            drive=ConstantDrive(waveform="constant", level=0.8),
        ),
    ),
)


@dataclass
class ManualClock:
    """A clock that advances by each sleep, and by ``step_ns`` per reading; sleeping calls ``on_sleep``."""

    now_ns: int = 1_000_000_000
    utc_offset_ns: int = 1_700_000_000_000_000_000
    step_ns: int = 0
    on_sleep: Callable[[], object] = field(default=lambda: None)

    def monotonic_ns(self) -> int:
        self.now_ns += self.step_ns
        return self.now_ns

    def utc_ns(self) -> int:
        return self.monotonic_ns() + self.utc_offset_ns

    def sleep(self, duration_s: float) -> None:
        self.now_ns += max(1, round(duration_s * 1e9))
        self.on_sleep()


class Pulses:
    """All that cameras see of a trigger."""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire

    def start(self, **changes: Any) -> None:
        run = trigger_run(**changes)
        period_ns = Fraction(run.line_period_ticks * 100, 9)
        self.wire.start(period_ns, Fraction(1), run.code.to_attrs())

    def stop(self) -> int:
        return self.wire.stop()


def trigger_run(**changes: Any) -> TriggerRun:
    """A run of S = 3 with 900 ticks (10 us at 90 MHz) per sub-step."""
    run = {"run_id": "run", "code": CODE, "substeps": 3, "substep_ticks": 900, "tag_every_lines": 16}
    return TriggerRun(**(run | changes))


def optics(arm: str, stages: int = 4, substeps: int = 3) -> SimulatedOptics:
    return SimulatedOptics(arm, GeometryConfig(stages=stages, substeps=substeps), LEDS)


def camera_config(**changes: Any) -> CameraConfig:
    return CameraConfig(**({"black_level_dn": 5.0, "responsivity_dn": 40.0} | changes))


def naive_lines(scene: Scene, code: Code, stages: int, substeps: int, arm: str, lines: range) -> np.ndarray:
    """Eq. (1), term by term."""
    M, S, n = stages, substeps, stages * substeps
    first, count = S * lines.start, S * len(lines) + n
    X = scene.frames(first, count).astype(np.float64)
    if arm == "b":
        X = np.rot90(X, 1, axes=(1, 2))
    E = code.bits(first, count).astype(np.float64)
    Y = np.zeros((len(lines), M))
    for i in range(len(lines)):
        for j in range(M):
            for r in range(n):
                for u in range(S):
                    t = S * i + r + u
                    Y[i, j] += X[t, r, j * S : (j + 1) * S].sum() * E[t]
    return Y


def read_lines(camera: Camera, lines: int, timeout_s: float = 300.0) -> list[np.ndarray]:
    """Return blocks until ``lines`` lines have come."""
    blocks, have = [], 0
    while have < lines:
        block = camera.next_block(timeout_s)
        assert block is not None, f"{have} of {lines} lines came"
        assert block.first_line == have
        assert block.flags.shape == (len(block.pixels),)
        blocks.append(block.pixels)
        have += len(block.pixels)
    return blocks


PATIENCE_S = 300.0
"""Against hanging: the first camera waits for pulses while the second one's process is being started."""


def camera_child(opener: CameraOpener, link: Connection) -> None:
    """Arm, say so, read a few blocks, be told the number of pulses, read the rest, send everything."""
    camera = opener()
    camera.arm()
    link.send("armed")
    early = camera.next_block(PATIENCE_S)
    assert early is not None
    assert link.poll(PATIENCE_S)
    pulses = link.recv()
    blocks = [early.pixels]
    while sum(map(len, blocks)) < pulses:
        block = camera.next_block(PATIENCE_S)
        assert block is not None
        blocks.append(block.pixels)
    after = camera.next_block(0.01)
    link.send((np.concatenate(blocks), after, camera.statistics()))
    camera.close()


def watching_child(wire: Wire, link: Connection) -> None:
    """Look at the wire as fast as possible; send the most pulses seen of each run."""
    most: dict[int, int] = {}
    looks = 0
    link.send("watching")
    while not link.poll(0):
        for _ in range(50):
            reading = wire.read()
            most[reading.run] = max(most.get(reading.run, 0), reading.issued)
            looks += 1
    link.send((most, looks))


def blas_child(opener: CameraOpener, link: Connection) -> None:
    """Open a camera, multiply for a while, send the processor time of this thread and of all the others."""
    opener()
    square = np.ones((500, 500))
    before, others_before = time.thread_time(), time.process_time() - time.thread_time()
    while time.thread_time() - before < 0.5:
        square @ square
    others = time.process_time() - time.thread_time() - others_before
    link.send((time.thread_time() - before, others))
