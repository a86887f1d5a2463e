"""What a rig is: geometry, code, capture path and what its parts have in common."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from acquire.codes import TAPS, Code, ConstantCode, PrbsCode
from acquire.config.base import MOST_SECONDS, SEED_END, FilePath, FrozenModel
from acquire.config.device import CamerasConfig, TriggerConfig
from acquire.config.event import CheckConfig, EventsConfig
from acquire.config.fibre import FibreConfig
from acquire.config.recording import USUAL_CHUNK_BYTES, RecordingConfig, usual_chunk_lines, usual_tag_chunks
from acquire.config.service import HooksConfig, ServiceConfig
from acquire.config.web import WebConfig
from acquire.errors import ConfigError, UsageError
from acquire.geometry import Geometry
from acquire.place import builtin_names, default_socket
from acquire.plugins import CAMERAS

if TYPE_CHECKING:
    from acquire.fibre import Fibre

RING_RESERVE_SHARE = 4
"""Of the ring's slots, one part in so many stays free for the cameras while a recording takes the past."""
EVENT_DELAY_S = 0.5
"""Between an event and the recording that it starts."""
WHOLE_STEPS = ("VT-4K5C-H100",)
"""Models of cameras that are known to have no intra-line charge transfer."""
MAX_RING_BYTES = 4 * 2**30
"""Pixels that may wait in the ring of one arm."""


class GeometryConfig(FrozenModel):
    """The sensor as the model sees it."""

    stages: int = Field(ge=1, le=4096, description="M, TDI stages; also pixels per line, but behind a fibre")
    substeps: int = Field(ge=1, le=8, description="S, charge-transfer steps per line")

    def segment(self, lines: int) -> Geometry:
        return Geometry(self.stages, self.substeps, lines)


class PrbsConfig(FrozenModel):
    """Maximal-length pseudo-random exposure code."""

    kind: Literal["prbs"] = "prbs"
    degree: int = Field(default=64, description="degree of the register: " + ", ".join(map(str, TAPS)))
    seed: int = Field(
        default=1, ge=0, lt=SEED_END, description="any number; the register's first state is mixed from it"
    )
    state: str | None = Field(
        default=None,
        pattern="^0x[0-9a-f]+$",
        description="the register's first state itself, instead of a seed",
    )

    @model_validator(mode="after")
    def _degree_known(self) -> PrbsConfig:
        if self.degree not in TAPS:  # of others, no taps are known here that make the longest sequence
            raise ValueError(f"degree {self.degree} is not one of {', '.join(map(str, TAPS))}")
        return self

    def build(self) -> Code:
        if self.state is not None:
            return PrbsCode(self.degree, int(self.state, 16))
        return PrbsCode.from_seed(self.degree, self.seed)


class ConstantCodeConfig(FrozenModel):
    """Light always on or off."""

    kind: Literal["constant"]
    value: Literal[0, 1] = 1

    def build(self) -> Code:
        return ConstantCode(self.value)


class StreamConfig(FrozenModel):
    """The capture path between camera and disk."""

    block_lines: int = Field(default=256, ge=1, le=65536, description="lines per camera block and ring slot")
    ring_slots: int = Field(default=64, ge=2, le=2**16)
    ring_seconds: float | None = Field(
        default=None,
        gt=0,
        le=MOST_SECONDS,
        description="of lines from the past that the ring holds, instead of ring_slots",
    )
    reopen_s: float = Field(default=2.0, ge=0, le=600, description="wait for a camera that is gone")
    stall_s: float = Field(
        default=3.0,
        gt=0,
        le=600,
        description="an arm that is silent for longer has stalled, unless its camera is waited for longer",
    )
    arm_timeout_s: float = Field(
        default=120.0,
        gt=0,
        le=3600,
        description="longest wait at arm for a process or a camera to become ready",
    )
    realtime: bool = Field(
        default=False,
        description="grabbers before everything else on the host, where its user may (RLIMIT_RTPRIO); "
        "not for simulated cameras, which compute",
    )


class ControlConfig(FrozenModel):
    """Where the daemon listens."""

    socket: FilePath = Field(default_factory=default_socket)


class SimulationConfig(FrozenModel):
    """What simulated devices see, and how fast their time runs."""

    scene: str | None = Field(
        default=None,
        description="what simulated cameras see: a scene file, beside this file or a built-in one; absent "
        "where no camera is simulated",
    )
    speed: float = Field(default=1.0, gt=0, le=1000, description="simulated seconds per second")
    replay: FilePath | None = Field(
        default=None, description="a recording whose lines the cameras give instead"
    )
    replay_loop: bool = Field(default=False, description="over and over")
    replay_gate: FilePath | None = Field(
        default=None, description="a file; before it exists, no replayed line comes"
    )


def _prbs_unless_said(value: Any) -> Any:
    """``[code]`` without a ``kind`` is pseudo-random, as the rig without ``[code]`` is."""
    return {"kind": "prbs", **value} if isinstance(value, dict) else value


class RigConfig(FrozenModel):
    """A whole instrument: everything the daemon needs to know."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$",
        max_length=128,
        description="recordings and the list of those to upload are named after it",
    )
    geometry: GeometryConfig
    code: Annotated[
        PrbsConfig | ConstantCodeConfig, Field(discriminator="kind"), BeforeValidator(_prbs_unless_said)
    ] = PrbsConfig()
    trigger: TriggerConfig = Field(default_factory=TriggerConfig)
    cameras: CamerasConfig
    fibre: FibreConfig | None = Field(
        default=None, description="layout 'fibre': how the bands of a larger scene lie on the sensors"
    )
    stream: StreamConfig = StreamConfig()
    recording: RecordingConfig = RecordingConfig()
    events: EventsConfig = EventsConfig()
    calibration: FilePath | None = Field(
        default=None,
        description="of this instrument, as `acquire calibrate` makes one: a path, also beside this file; "
        "every recording gets a copy",
    )
    check: CheckConfig = CheckConfig()
    control: ControlConfig = Field(default_factory=ControlConfig)
    simulation: SimulationConfig = SimulationConfig()
    service: ServiceConfig = ServiceConfig()
    hooks: HooksConfig = HooksConfig()
    web: WebConfig | None = Field(default=None, description="absent: the daemon starts no page")

    @model_validator(mode="after")
    def _fibre_meant(self) -> RigConfig:
        """Before the ring, which holds lines as wide as the sensor behind a fibre."""
        laid = self.cameras.layout == "fibre"
        if self.fibre is None and laid:
            raise ValueError("cameras.layout = 'fibre' needs [fibre] with rows, columns and sensor_pixels")
        if self.fibre is not None and not laid:
            raise ValueError(
                f"[fibre] goes with another cameras.layout than {self.cameras.layout!r}; possible: 'fibre'"
            )
        try:
            self.laid_out  # noqa: B018  # what cannot be is refused when it is built
        except UsageError as error:
            raise ValueError(str(error)) from error
        return self

    @model_validator(mode="after")
    def _ring_fits(self) -> RigConfig:
        """Lines wait for their tag in the ring, and no longer once half of it is full: a sixth is for a tag
        that comes late on a busy host.
        """
        lines = self.ring_slots * self.stream.block_lines
        pixel_bytes = 1 if self.cameras.a.dtype == "uint8" else 2
        if (size := lines * self.pixels * pixel_bytes) > MAX_RING_BYTES:
            raise ValueError(
                f"stream.{self._ring_keys} = {lines} lines of {self.pixels} pixels "
                f"are {size} bytes of memory per arm; possible: up to {MAX_RING_BYTES}"
            )
        if self.trigger.tag_every_lines > lines // 3:
            raise ValueError(
                f"trigger.tag_every_lines cannot be {self.trigger.tag_every_lines}; possible: 1 to "
                f"{lines // 3}, a third of what a ring holds (stream.{self._ring_keys})"
            )
        return self

    @model_validator(mode="after")
    def _stages_meant(self) -> RigConfig:
        """What a camera is set to, where that is known, has to be what the model is told."""
        for arm, camera in (("a", self.cameras.a), ("b", self.cameras.b)):
            for _, feature, value in camera.settings:
                if feature == "TDIStages" and value != f"TDI{self.geometry.stages}":
                    raise ValueError(
                        f"cameras.{arm}.settings: TDIStages is {value!r}, and geometry.stages is "
                        f"{self.geometry.stages}; possible: TDI{self.geometry.stages}"
                    )
            if self.geometry.substeps > 1 and camera.model in WHOLE_STEPS:
                raise ValueError(
                    f"geometry.substeps = {self.geometry.substeps} does not go with cameras.{arm}.model = "
                    f"{camera.model!r}, which moves its charge once a line; possible: substeps = 1, and as "
                    "many stages as it has TDI stages; acquire cut --merge makes intra-line lines of those"
                )
        return self

    @model_validator(mode="after")
    def _past_fits(self) -> RigConfig:
        """An event is noticed, and its recording created, while the ring goes on."""
        longest_s = self.history_s - EVENT_DELAY_S * self.simulation.speed
        if self.events.sources and self.events.pre_s > longest_s:
            raise ValueError(
                f"events.pre_s cannot be {self.events.pre_s:g}; possible: up to {max(0.0, longest_s):.3g}, "
                f"since the ring holds {self.history_s:.3g} s; a longer one: stream.ring_seconds"
            )
        return self

    @model_validator(mode="after")
    def _arms_apart(self) -> RigConfig:
        if self.columns:
            first, second = sorted(self.columns.values())
            if second[0] < first[1]:
                raise ValueError(f"cameras.a and b overlap in columns {second[0]} to {first[1] - 1}")
        return self

    @property
    def simulates_cameras(self) -> bool:
        """Whether the trigger's pulses go to a camera that is simulated."""
        return any(CAMERAS.load(camera.driver).simulated for camera in (self.cameras.a, self.cameras.b))

    @property
    def needs_scene(self) -> bool:
        """Whether an arm's lines are computed from what its camera sees."""
        return self.simulation.replay is None and any(
            CAMERAS.load(camera.driver).sees_scene for camera in (self.cameras.a, self.cameras.b)
        )

    def scene_file(self) -> str:
        """What simulated cameras see. Raises ConfigError where nothing is said of it."""
        if self.simulation.scene is None:
            raise ConfigError(
                f"rig {self.name}: simulation.scene is missing, which simulated cameras see",
                possible=f"a scene file, a picture or a video, or one of {', '.join(builtin_names('scene'))}",
                hint='simulation.scene = "scene-leds", or cameras of another driver',
            )
        return self.simulation.scene

    @property
    def laid_out(self) -> Fibre | None:
        """Layout 'fibre': which column sees what; None in the others."""
        sizes = self.geometry
        return None if self.fibre is None else self.fibre.build(sizes.stages, sizes.substeps)

    @property
    def pixels(self) -> int:
        """Of a line of one arm: as many as there are stages, or as the sensors behind a fibre are wide."""
        return self.geometry.stages if self.fibre is None else self.fibre.sensor_pixels

    @property
    def columns(self) -> dict[str, tuple[int, int]]:
        """Compact layout: arm → first column and the one after the last; empty in the others."""
        if self.cameras.layout != "compact":
            return {}
        starts = {"a": self.cameras.a.first_column, "b": self.cameras.b.first_column}
        return {arm: (start, start + self.geometry.stages) for arm, start in starts.items()}

    @property
    def ring_slots(self) -> int:
        """Slots of the ring of one arm."""
        seconds = self.stream.ring_seconds
        if seconds is None:
            return self.stream.ring_slots
        # One more for the slot that is being filled; and the reserve, which is a share of all slots, on top.
        past = math.ceil(seconds * self.line_rate_hz / self.stream.block_lines) + 1
        return past + max(2, math.ceil(past / (RING_RESERVE_SHARE - 1)))

    @property
    def chunk_lines(self) -> int:
        """Lines per chunk of a recording. A block of some MB is one chunk: it is written without a copy."""
        if self.recording.chunk_lines is not None:
            return self.recording.chunk_lines
        line_bytes = self.pixels * np.dtype(self.cameras.a.dtype).itemsize
        block_lines = self.stream.block_lines
        if USUAL_CHUNK_BYTES // 4 <= block_lines * line_bytes <= USUAL_CHUNK_BYTES:
            return block_lines
        return usual_chunk_lines(line_bytes, self.line_rate_hz)

    @property
    def tag_chunks(self) -> int:
        """Chunks of a recording's lines whose tags share one chunk."""
        recording = self.recording
        return usual_tag_chunks(
            self.chunk_lines, recording.shard_chunks, self.line_rate_hz, recording.commit_s
        )

    @property
    def ring_reserve(self) -> int:
        """Those of them that do not serve as history."""
        return max(2, self.ring_slots // RING_RESERVE_SHARE)

    @property
    def history_s(self) -> float:
        """Seconds of lines from the past that a full ring holds for certain."""
        slots = self.ring_slots - self.ring_reserve - 1
        return max(0, slots) * self.stream.block_lines / self.line_rate_hz

    @property
    def _ring_keys(self) -> str:
        return "ring_slots x stream.block_lines" if self.stream.ring_seconds is None else "ring_seconds"

    @property
    def line_period_ticks(self) -> int:
        return self.geometry.substeps * self.trigger.substep_ticks

    @property
    def line_rate_hz(self) -> float:
        return self.trigger.clock_hz / self.line_period_ticks
