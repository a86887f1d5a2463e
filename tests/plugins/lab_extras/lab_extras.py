"""What a laboratory adds: a lamp on the mains, stars, a camera that counts, a slow link, a codec, solvers."""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.arrays import host
from acquire.camera.variant import CameraVariant
from acquire.forward import DualArm
from acquire.recon.solver import Solver
from acquire.sim.devices import SimulatedCamera
from acquire.sim.drivers import SimulatedTrigger
from acquire.sim.effects.base import Effect, Place, Stage
from acquire.sim.readout import Readout
from acquire.sim.scene import MaskScene, SceneModel
from acquire.store.variant import CodecVariant


class Flicker(Effect):
    """A lamp on the mains: its light varies at twice the mains frequency."""

    kind: Literal["flicker"]
    place: ClassVar[Place] = "light"
    depth: float = Field(gt=0, le=1, description="of the light, from its mean to its extremes")
    mains_hz: float = Field(default=50.0, gt=0)

    def stages(self, setting):
        turns_per_substep = 2 * self.mains_hz * setting.substep_s

        def wrap(light):
            def swung(first, count):
                turns = (np.arange(first, first + count) + 0.5) * turns_per_substep
                return light.light(first, count) * (1 + self.depth * np.sin(2 * np.pi * turns))

            return replace(light, light=swung)

        return [Stage("flicker", "light", wrap)]


class Stars(SceneModel):
    """Points of light at random places, each twinkling at a rate of its own."""

    kind: Literal["stars"]
    count: int = Field(default=9, ge=1, le=1000)
    places: int = Field(default=0, ge=0, description="another number, other places")
    fastest_hz: float = Field(default=2000.0, gt=0)

    def build(self, size, substep_s):
        return StarScene(self, size, substep_s)


class StarScene(MaskScene):
    """One mask of one pixel per star."""

    def __init__(self, config, size, substep_s):
        draws = np.random.default_rng(config.places)
        self._rate_hz = draws.uniform(0.1, 1.0, config.count) * config.fastest_hz
        self._substep_s = substep_s
        self.masks = np.zeros((config.count, size, size), np.float32)
        for mask in self.masks:
            mask[tuple(draws.integers(0, size, 2))] = 1.0

    def intensity(self, first, count, substep_s=None):
        time_s = (np.arange(first, first + count) + 0.5) * (substep_s or self._substep_s)
        return 0.5 + 0.5 * np.sin(2 * np.pi * self._rate_hz[:, None] * time_s)


class RampCameras(CameraVariant):
    """Cameras whose line k has the pixels step·k + column, so that a reader knows what to expect."""

    simulated: ClassVar[bool] = True  # it is pulsed by the simulated trigger
    sees_light: ClassVar[bool] = False  # its lines do not follow the light's code
    step: int = Field(default=1, ge=1, le=100, description="DN from line to line")

    def opener(self, config, arm, bench):
        camera = config.cameras.arm(arm)
        ramp = Ramp(config.geometry, self.step, camera.white_dn, camera.dtype)
        return RampOpener(bench.pulses(arm), ramp, camera, config.stream.block_lines, config.line_rate_hz)


@dataclass(frozen=True)
class RampOpener:
    """Opens the camera, in the process that takes its lines."""

    pulses: Any
    ramp: Ramp
    camera: Any
    block_lines: int
    line_rate_hz: float

    def __call__(self):
        return SimulatedCamera(self.pulses, self.ramp, self.camera, self.block_lines, self.line_rate_hz)


@dataclass(frozen=True)
class Ramp:
    """In place of a lens and a sensor."""

    geometry: Any
    step: int
    white_dn: int
    dtype: str

    def expose(self, train, code, config):
        return self

    def read(self, first_line, count):
        line, column = np.arange(first_line, first_line + count), np.arange(self.geometry.stages)
        pixels = (self.step * line[:, None] + column) % self.white_dn
        return Readout(pixels.astype(self.dtype), np.zeros(count, bool))


class SlowLinkTrigger(SimulatedTrigger):
    """The simulated trigger behind a slow link: its messages come late."""

    delay_s: float = Field(default=0.002, ge=0, le=0.05)

    def transport(self, config, bench):
        connect = super().transport(config, bench)
        return lambda: SlowLink(connect(), self.delay_s)


class SlowLink:
    """Carries bytes as another transport does, but later."""

    def __init__(self, way, delay_s):
        self.name, self.bytes_per_s = f"{way.name}, slowed down", way.bytes_per_s
        self.write, self.close = way.write, way.close
        self._way, self._delay_s = way, delay_s

    def read(self):
        data = self._way.read()
        if data:
            time.sleep(self._delay_s)
        return data


class Differences(CodecVariant):
    """Every line as the bits that differ from the line before, packed by zlib: small where little moves."""

    zarr_name: ClassVar[str] = "lab_extras.differences"
    level: int = Field(default=1, ge=1, le=9, description="of zlib: 1 is fastest")
    line_bytes: int = Field(default=1, ge=1, description="set by the recorder")

    def fitted(self, line_bytes, item_bytes):
        return self.model_copy(update={"line_bytes": line_bytes})

    def encode(self, data):
        lines = np.frombuffer(data, np.uint8).reshape(-1, self.line_bytes)
        changes = lines.copy()
        changes[1:] ^= lines[:-1]
        return zlib.compress(changes, self.level)

    def decode(self, data, size):
        changes = np.frombuffer(zlib.decompress(data, bufsize=size), np.uint8)
        return np.bitwise_xor.accumulate(changes.reshape(-1, self.line_bytes))


class LeastSquares(Solver):
    """min ½‖Λx − y‖² + ½·ridge·‖x‖² over x ≥ 0, by Nesterov's accelerated projected gradient."""

    ridge: float = Field(default=1e-3, ge=0)

    def solve(self, segment, problem, request, clock):
        problem = problem.on_host()
        merges = request.spatial_merge, request.temporal_merge
        known = {"alignment": segment.alignment, "blur": segment.blur}
        model = DualArm(segment.geometry, segment.code, *merges, **known)
        operator, samples = problem.masked(model), problem.used_samples  # of norm at most 1
        answer = Answer(model, problem.norm, np.zeros(model.video_shape, np.float32))
        ahead, momentum = answer.x, 1.0
        for _ in clock.run(request.iterations, "least squares", video=answer.video):
            gradient = operator.adjoint(operator.forward(ahead) - samples) + self.ridge * ahead
            stepped = np.maximum(ahead - gradient / (1 + self.ridge), 0)
            following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
            ahead = stepped + (momentum - 1) / following * (stepped - answer.x)
            answer.x, momentum = stepped, following
        return answer


@dataclass
class Answer:
    """The result of a solver."""

    model: Any
    norm: float
    x: Any
    held_out_error: None = None

    def predict(self):
        return host(self.model.forward(self.x)) / self.norm

    def video(self):
        return self.x.copy()

    def facts(self):
        return {}


class LocalWiener:
    """Pixels towards the mean of the 3 × 3 around, as far as noise explains their spread (Lee 1980)."""

    def prox(self, frames, weight):
        noise = np.broadcast_to(np.asarray(weight, frames.dtype) ** 2, len(frames))[:, None, None]
        padded = np.pad(frames, ((0, 0), (1, 1), (1, 1)), mode="edge")
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
        mean, variance = around.mean(axis=(3, 4)), around.var(axis=(3, 4))
        kept = np.maximum(variance - noise, 0) / np.maximum(variance, np.finfo(frames.dtype).tiny)
        return mean + kept * (frames - mean)
