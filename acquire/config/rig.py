"""Model of a rig: geometry, code, capture path, and the constraints between its tables."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

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
    from collections.abc import Callable

    from acquire.fibre import Fibre

RING_RESERVE_SHARE = 4
"""One in this many ring slots stays free for the cameras while a recording reads the past."""
EVENT_DELAY_S = 0.5
"""Time between an event and the recording that it starts."""
WHOLE_STEPS = ("VT-4K5C-H100",)
"""Camera models that are known to have no intra-line charge transfer."""
MAX_RING_BYTES = 4 * 2**30
"""Largest ring of one arm."""
RECORDED = {"recorded": True}
"""Context in which the rig of a recording is validated: limits of the capture path do not apply to it."""
MOST_TAGS_PER_S = 10_000
"""A free processor reads three times as many. To a host that lags behind, the trigger seems to be late."""
MOST_URGENT_BLOCKS_PER_S = 2000
"""Blocks per second and arm of grabbers in real time. The ring takes 27 us for a block of any size, a driver
takes more, and nothing else runs on that core meanwhile, not even the process that supervises it."""


class GeometryConfig(FrozenModel):
    """The sensor in the forward model."""

    stages: int = Field(ge=1, le=4096, description="M, TDI stages; without a fibre also the pixels per line")
    # A recording keeps a line's code bits in one byte.
    substeps: int = Field(ge=1, le=8, description="S, charge-transfer steps per line")

    def segment(self, lines: int) -> Geometry:
        """Return the geometry of a segment of ``lines`` lines."""
        return Geometry(self.stages, self.substeps, lines)


class PrbsConfig(FrozenModel):
    """Maximal-length pseudo-random exposure code."""

    kind: Literal["prbs"] = "prbs"
    # Of degree 64 no run sees the code repeat: 2**64 sub-steps of 10 µs last six million years.
    degree: int = Field(default=64, description="degree of the register: " + ", ".join(map(str, TAPS)))
    seed: int = Field(
        default=1, ge=0, lt=SEED_END, description="any number; the register's first state is derived from it"
    )
    # A text, because JSON readers in other languages do not keep 64 bits of a number exactly.
    state: str | None = Field(
        default=None,
        pattern="^0x[0-9a-f]+$",
        description="the register's first state, instead of a seed",
    )

    @model_validator(mode="after")
    def _degree_known(self) -> PrbsConfig:
        if self.degree not in TAPS:  # taps of a maximal-length sequence are known only for these degrees
            raise ValueError(f"degree {self.degree} is not one of {', '.join(map(str, TAPS))}")
        return self

    def build(self) -> Code:
        """Return the code: of the state, if there is one, else of the seed."""
        if self.state is not None:
            return PrbsCode(self.degree, int(self.state, 16))
        return PrbsCode.from_seed(self.degree, self.seed)


class ConstantCodeConfig(FrozenModel):
    """Light always on or off."""

    kind: Literal["constant"]
    value: Literal[0, 1] = 1

    def build(self) -> Code:
        """Return the code of a light that is always on, or off."""
        return ConstantCode(self.value)


class StreamConfig(FrozenModel):
    """The capture path between camera and disk."""

    block_lines: int = Field(default=256, ge=1, le=65536, description="lines per camera block and ring slot")
    ring_slots: int = Field(default=64, ge=2, le=2**16)
    ring_seconds: float | None = Field(
        default=None,
        gt=0,
        le=MOST_SECONDS,
        description="past lines that the ring holds, in seconds, instead of ring_slots",
    )
    reopen_s: float = Field(
        default=2.0, ge=0, le=600, description="longest wait for a camera that is gone to come back"
    )
    stall_s: float = Field(
        default=3.0,
        gt=0,
        le=600,
        description="silence after which an arm has stalled, unless reopen_s grants its camera more time",
    )
    arm_timeout_s: float = Field(
        default=120.0,
        gt=0,
        le=3600,
        description="longest wait at arm for a process or a camera to become ready",
    )
    realtime: bool = Field(
        default=False,
        description="true: grabbers take precedence over everything else on the host, if the user may do so "
        "(RLIMIT_RTPRIO); not for simulated cameras, which compute",
    )


class ControlConfig(FrozenModel):
    """The socket on which the daemon listens."""

    socket: FilePath = Field(default_factory=default_socket)


class SimulationConfig(FrozenModel):
    """The scene of simulated devices, and the speed of their time."""

    scene: str | None = Field(
        default=None,
        description="scene before simulated cameras: a scene file next to this file, or a built-in one; "
        "absent if no camera is simulated",
    )
    speed: float = Field(default=1.0, gt=0, le=1000, description="simulated seconds per second")
    replay: FilePath | None = Field(
        default=None, description="a recording whose lines the cameras replay instead of a scene"
    )
    replay_loop: bool = Field(default=False, description="true: repeat the recording endlessly")
    replay_gate: FilePath | None = Field(
        default=None, description="a file; no replayed line comes before it exists"
    )

    @model_validator(mode="before")
    @classmethod
    def _drop_replay_hold(cls, table: Any) -> Any:
        """Drop a key that rig files had until replays got a gate, where it has no effect."""
        if not isinstance(table, dict) or "replay_hold_s" not in table:
            return table
        if table["replay_hold_s"] != 0:
            raise ValueError("replay_hold_s is gone; possible: replay_gate, a file for which a replay waits")
        return {key: value for key, value in table.items() if key != "replay_hold_s"}


def _limit_of_capture(check: Callable[[RigConfig], None]) -> Any:
    """Make ``check`` a validator of rigs, except those of recordings, whose lines are only read."""

    def validate(rig: RigConfig, info: ValidationInfo) -> RigConfig:
        if not (info.context and info.context.get("recorded")):
            check(rig)
        return rig

    return model_validator(mode="after")(validate)


def _default_to_prbs(value: Any) -> Any:
    """Make ``[code]`` without a ``kind`` pseudo-random, as it is in a rig without ``[code]``."""
    # The discriminator of a union must be given: a default of `kind` alone is not used for it.
    return {"kind": "prbs", **value} if isinstance(value, dict) else value


class RigConfig(FrozenModel):
    """A whole instrument: everything that the daemon needs."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$",
        max_length=128,
        description="name after which recordings and the list of pending uploads are named",
    )
    geometry: GeometryConfig
    code: Annotated[
        PrbsConfig | ConstantCodeConfig, Field(discriminator="kind"), BeforeValidator(_default_to_prbs)
    ] = PrbsConfig()
    # Not made with the class: that would import the default driver, which is part of the simulator.
    trigger: TriggerConfig = Field(default_factory=TriggerConfig)
    cameras: CamerasConfig
    fibre: FibreConfig | None = Field(
        default=None, description="layout 'fibre': positions of the bands of a larger scene on the sensors"
    )
    stream: StreamConfig = StreamConfig()
    recording: RecordingConfig = RecordingConfig()
    events: EventsConfig = EventsConfig()
    calibration: FilePath | None = Field(
        default=None,
        description="calibration of this instrument, made with `acquire calibrate`: a path, which may be "
        "relative to this file; every recording gets a copy",
    )
    check: CheckConfig = CheckConfig()
    # Made with each rig: the default depends on the environment (XDG_RUNTIME_DIR).
    control: ControlConfig = Field(default_factory=ControlConfig)
    simulation: SimulationConfig = SimulationConfig()
    service: ServiceConfig = ServiceConfig()
    hooks: HooksConfig = HooksConfig()
    web: WebConfig | None = Field(default=None, description="absent: the daemon starts no page")

    @model_validator(mode="after")
    def _fibre_matches_layout(self) -> RigConfig:
        """Checked before the ring, whose lines are as wide as the sensor behind a fibre."""
        has_layout = self.cameras.layout == "fibre"
        if self.fibre is None and has_layout:
            raise ValueError("cameras.layout = 'fibre' needs [fibre] with rows, columns and sensor_pixels")
        if self.fibre is not None and not has_layout:
            raise ValueError(
                f"[fibre] cannot be used with cameras.layout = {self.cameras.layout!r}; possible: 'fibre'"
            )
        try:
            self.laid_out  # noqa: B018  # building it raises UsageError for an impossible fibre
        except UsageError as error:
            raise ValueError(str(error)) from error
        return self

    @_limit_of_capture
    def _ring_fits(self) -> None:
        """Lines wait in the ring for their tag until half of it is full.

        Tags every third of the ring leave a sixth of it for a tag that is late on a busy host.
        """
        lines = self.ring_slots * self.stream.block_lines
        pixel_bytes = 1 if self.cameras.a.dtype == "uint8" else 2
        if (size := lines * self.pixels * pixel_bytes) > MAX_RING_BYTES:
            raise ValueError(
                f"stream.{self._ring_keys} = {lines} lines of {self.pixels} pixels "
                f"need {size} bytes of memory per arm; possible: up to {MAX_RING_BYTES}"
            )
        if self.trigger.tag_every_lines > lines // 3:
            raise ValueError(
                f"trigger.tag_every_lines cannot be {self.trigger.tag_every_lines}; possible: 1 to "
                f"{lines // 3}, a third of what a ring holds (stream.{self._ring_keys})"
            )

    @_limit_of_capture
    def _blocks_come_before_a_stall(self) -> None:
        """A camera delivers whole blocks: until one is full, its arm is silent."""
        passing_hz, most_s = self.passing_hz, self.stall_timeout_s / 2
        if (block_s := self.stream.block_lines / passing_hz) > most_s:
            raise ValueError(
                f"stream.block_lines cannot be {self.stream.block_lines}: at {passing_hz:g} lines/s such a "
                f"block takes {block_s:.3g} s; possible: up to {math.floor(passing_hz * most_s)}, half the "
                "time after which an arm counts as stalled (stream.stall_s, stream.reopen_s)"
            )

    @_limit_of_capture
    def _grabbers_leave_time(self) -> None:
        """Grabbers that run ahead of everything else must not take all of the processor's time."""
        if not self.stream.realtime:
            return
        passing_hz = self.passing_hz
        fewest = math.ceil(passing_hz / MOST_URGENT_BLOCKS_PER_S)
        if self.stream.block_lines < fewest:
            raise ValueError(
                f"stream.block_lines cannot be {self.stream.block_lines} with stream.realtime: at "
                f"{passing_hz:g} lines/s, {passing_hz / self.stream.block_lines:.0f} blocks/s would keep "
                f"everything else from running; possible: {fewest} or more, or realtime = false"
            )

    @_limit_of_capture
    def _tags_can_be_read(self) -> None:
        passing_hz = self.passing_hz
        # At 50 000 tags/s the supervisor fell behind, and the run ended as if the camera had not waited for
        # the trigger.
        fewest = math.ceil(passing_hz / MOST_TAGS_PER_S)
        if self.trigger.tag_every_lines < fewest:
            raise ValueError(
                f"trigger.tag_every_lines cannot be {self.trigger.tag_every_lines} at {passing_hz:g} "
                f"lines/s; possible: {fewest} or more, since the host reads up to {MOST_TAGS_PER_S} tags/s"
            )

    @model_validator(mode="after")
    def _geometry_matches_cameras(self) -> RigConfig:
        """The geometry must agree with the cameras' settings, as far as these are known."""
        for arm, camera in (("a", self.cameras.a), ("b", self.cameras.b)):
            for _, feature, value in camera.settings:
                # SFNC has no name for this: feature and entries are named as in Vieworks' VT cameras.
                if feature == "TDIStages" and value != f"TDI{self.geometry.stages}":
                    raise ValueError(
                        f"cameras.{arm}.settings: TDIStages is {value!r}, but geometry.stages is "
                        f"{self.geometry.stages}; possible: TDI{self.geometry.stages}"
                    )
            if self.geometry.substeps > 1 and camera.model in WHOLE_STEPS:
                raise ValueError(
                    f"geometry.substeps = {self.geometry.substeps} cannot be used with cameras.{arm}.model = "
                    f"{camera.model!r}, which moves its charge once per line; possible: substeps = 1, with "
                    "stages set to its TDI stages; acquire cut --merge then makes intra-line lines"
                )
        return self

    @_limit_of_capture
    def _past_fits(self) -> None:
        """The ring keeps filling while an event is detected and its recording is created."""
        # The delay is in the time of the host, the history in that of the instrument.
        longest_s = self.history_s - EVENT_DELAY_S * self.simulation.speed
        if self.events.sources and self.events.pre_s > longest_s:
            raise ValueError(
                f"events.pre_s cannot be {self.events.pre_s:g}; possible: up to {max(0.0, longest_s):.3g}, "
                f"since the ring holds {self.history_s:.3g} s; stream.ring_seconds makes it longer"
            )

    @model_validator(mode="after")
    def _arms_apart(self) -> RigConfig:
        if self.columns:
            first, second = sorted(self.columns.values())
            if second[0] < first[1]:
                raise ValueError(f"cameras.a and b overlap in columns {second[0]} to {first[1] - 1}")
        return self

    @property
    def simulates_cameras(self) -> bool:
        """True if any camera is simulated."""
        return any(CAMERAS.load(camera.driver).simulated for camera in (self.cameras.a, self.cameras.b))

    @property
    def needs_scene(self) -> bool:
        """True if the lines of an arm are computed from a scene."""
        return self.simulation.replay is None and any(
            CAMERAS.load(camera.driver).sees_scene for camera in (self.cameras.a, self.cameras.b)
        )

    def scene_file(self) -> str:
        """Return the scene of simulated cameras. Raises ConfigError if the rig names none."""
        if self.simulation.scene is None:
            raise ConfigError(
                f"rig {self.name} has simulated cameras, and simulation.scene is missing",
                possible=f"a scene file, a picture or a video, or one of {', '.join(builtin_names('scene'))}",
                hint='set simulation.scene = "scene-leds", or choose cameras with another driver',
            )
        return self.simulation.scene

    @property
    def laid_out(self) -> Fibre | None:
        """The fibre of layout 'fibre', which maps the scene to columns; None in the other layouts."""
        sizes = self.geometry
        return None if self.fibre is None else self.fibre.build(sizes.stages, sizes.substeps)

    @property
    def pixels(self) -> int:
        """Pixels of one arm's line: the number of stages, or the width of the sensors behind a fibre."""
        return self.geometry.stages if self.fibre is None else self.fibre.sensor_pixels

    @property
    def columns(self) -> dict[str, tuple[int, int]]:
        """Compact layout: arm → first and end column of its image; empty in the other layouts."""
        if self.cameras.layout != "compact":
            return {}
        starts = {"a": self.cameras.a.first_column, "b": self.cameras.b.first_column}
        return {arm: (start, start + self.geometry.stages) for arm, start in starts.items()}

    @property
    def ring_slots(self) -> int:
        """Number of slots in the ring of one arm."""
        seconds = self.stream.ring_seconds
        if seconds is None:
            return self.stream.ring_slots
        # One more for the slot that is being filled, plus the reserve, which is a fraction of all slots.
        past = math.ceil(seconds * self.line_rate_hz / self.stream.block_lines) + 1
        return past + max(2, math.ceil(past / (RING_RESERVE_SHARE - 1)))

    @property
    def chunk_lines(self) -> int:
        """Lines per chunk of a recording. A block of 0.5 to 2 MiB is one chunk, written without a copy."""
        if self.recording.chunk_lines is not None:
            return self.recording.chunk_lines
        line_bytes = self.pixels * np.dtype(self.cameras.a.dtype).itemsize
        block_lines = self.stream.block_lines
        if USUAL_CHUNK_BYTES // 4 <= block_lines * line_bytes <= USUAL_CHUNK_BYTES:
            return block_lines
        return usual_chunk_lines(line_bytes, self.line_rate_hz)

    @property
    def tag_chunks(self) -> int:
        """Number of a recording's chunks of lines whose tags share one chunk."""
        recording = self.recording
        return usual_tag_chunks(
            self.chunk_lines, recording.shard_chunks, self.line_rate_hz, recording.commit_s
        )

    @property
    def ring_reserve(self) -> int:
        """Number of ring slots that are not used as history."""
        return max(2, self.ring_slots // RING_RESERVE_SHARE)

    @property
    def history_s(self) -> float:
        """Seconds of past lines that a full ring is guaranteed to hold."""
        # Neither the reserve nor the slot that is being filled holds the past.
        slots = self.ring_slots - self.ring_reserve - 1
        return max(0, slots) * self.stream.block_lines / self.line_rate_hz

    @property
    def _ring_keys(self) -> str:
        return "ring_slots x stream.block_lines" if self.stream.ring_seconds is None else "ring_seconds"

    @property
    def line_period_ticks(self) -> int:
        """Time from one line to the next, in periods of the trigger's clock."""
        return self.geometry.substeps * self.trigger.substep_ticks

    @property
    def stall_timeout_s(self) -> float:
        """Time without a line after which an arm counts as stalled; until then a camera may be reopened."""
        # Longer than the wait for a camera that is gone: its arm would otherwise count as stalled first.
        return max(self.stream.stall_s, self.stream.reopen_s + 1.0)

    @property
    def line_rate_hz(self) -> float:
        """Lines per second of each arm, by the trigger's clock."""
        return self.trigger.clock_hz / self.line_period_ticks

    @property
    def passing_hz(self) -> float:
        """Lines per second of the host's time, in which simulated lines pass `speed` times as fast."""
        return self.line_rate_hz * self.simulation.speed
