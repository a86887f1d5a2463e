"""Models of the files in ``configs/``: what a rig is, what a scene shows.

Unknown keys are refused. An error names the file, the key, what stood there and what is allowed.
"""

from __future__ import annotations

import math
import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, ValidationError, model_validator

from acquire.codes import TAPS, Code, ConstantCode, PrbsCode, mix_seed
from acquire.config_errors import explained
from acquire.device_config import SEEING_CAMERAS, SIMULATED_CAMERAS, CamerasConfig, TriggerConfig
from acquire.effect_config import MOST_SECONDS, SEED_END, FilePath, FrozenModel
from acquire.errors import ConfigError
from acquire.event_config import CheckConfig, EventsConfig
from acquire.geometry import Geometry
from acquire.place import default_socket
from acquire.plan_config import ReconstructionPlan
from acquire.reading import read_regular
from acquire.recording_config import USUAL_CHUNK_BYTES, RecordingConfig, usual_chunk_lines, usual_tag_chunks
from acquire.scene_config import SceneConfig, SceneFile, VideoSceneConfig, anchored
from acquire.service_config import HooksConfig, ServiceConfig
from acquire.text import shortened, shown
from acquire.web_config import WebConfig

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

RING_RESERVE_SHARE = 4
"""Of the ring's slots, one part in so many stays free for the cameras while a recording takes the past."""
EVENT_DELAY_S = 0.5
"""Between an event and the recording that it starts."""
MOST_FILE_BYTES = 2**20
"""Of a file of this kind; written by hand, they have some kilobytes."""
WHOLE_STEPS = ("VT-4K5C-H100",)
"""Models of cameras that are known to have no intra-line charge transfer."""
MAX_RING_BYTES = 4 * 2**30
"""Pixels that may wait in the ring of one arm."""

M = TypeVar("M", bound=BaseModel)


class GeometryConfig(FrozenModel):
    """The sensor as the model sees it."""

    stages: int = Field(ge=1, le=4096, description="M, TDI stages; also pixels per line")
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
        if self.degree not in TAPS:
            raise ValueError(f"degree {self.degree} is not one of {', '.join(map(str, TAPS))}")
        return self

    def build(self) -> Code:
        state = mix_seed(self.seed, self.degree) if self.state is None else int(self.state, 16)
        return PrbsCode(self.degree, state)


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
    trigger: TriggerConfig = TriggerConfig()
    cameras: CamerasConfig
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
    def _ring_fits(self) -> RigConfig:
        """Lines wait for their tag in the ring, of which half must stay free for the cameras."""
        lines = self.ring_slots * self.stream.block_lines
        pixel_bytes = 1 if self.cameras.a.dtype == "uint8" else 2
        if (size := lines * self.geometry.stages * pixel_bytes) > MAX_RING_BYTES:
            raise ValueError(
                f"stream.{self._ring_keys} = {lines} lines of {self.geometry.stages} pixels "
                f"are {size} bytes of memory per arm; possible: up to {MAX_RING_BYTES}"
            )
        if self.trigger.tag_every_lines > lines // 2:
            raise ValueError(
                f"trigger.tag_every_lines = {self.trigger.tag_every_lines}; possible: 1 to {lines // 2}, "
                f"half of what a ring holds (stream.{self._ring_keys})"
            )
        return self

    @model_validator(mode="after")
    def _stages_meant(self) -> RigConfig:
        """What a camera is set to, where that is known, has to be what the model is told."""
        for arm, camera in (("a", self.cameras.a), ("b", self.cameras.b)):
            for _, feature, value in camera.settings:
                if feature == "TDIStages" and value != f"TDI{self.geometry.stages}":
                    raise ValueError(
                        f"cameras.{arm}.settings: TDIStages {value!r} with geometry.stages = "
                        f"{self.geometry.stages}; possible: TDI{self.geometry.stages}"
                    )
            if self.geometry.substeps > 1 and camera.model in WHOLE_STEPS:
                raise ValueError(
                    f"geometry.substeps = {self.geometry.substeps} with cameras.{arm}.model = "
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
                f"events.pre_s = {self.events.pre_s:g}; possible: up to {max(0.0, longest_s):.3g}, "
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
        return any(camera.driver in SIMULATED_CAMERAS for camera in (self.cameras.a, self.cameras.b))

    @property
    def needs_scene(self) -> bool:
        """Whether an arm's lines are computed from what its camera sees."""
        return self.simulation.replay is None and any(
            camera.driver in SEEING_CAMERAS for camera in (self.cameras.a, self.cameras.b)
        )

    def scene_file(self) -> str:
        """What simulated cameras see. Raises ConfigError where nothing is said of it."""
        if self.simulation.scene is None:
            scenes = (path.stem for path in sorted(builtin_directory().glob("scene-*.toml")))
            raise ConfigError(
                f"rig {self.name}: simulation.scene is missing, which simulated cameras see",
                possible=f"a scene file, a picture or a video, or one of {', '.join(scenes)}",
                hint='simulation.scene = "scene-leds", or cameras of another driver',
            )
        return self.simulation.scene

    @property
    def columns(self) -> dict[str, tuple[int, int]]:
        """Compact layout: arm → first column and the one after the last; empty in dual layout."""
        if self.cameras.layout == "dual":
            return {}
        starts = {"a": self.cameras.a.first_column, "b": self.cameras.b.first_column}
        return {arm: (start, start + self.geometry.stages) for arm, start in starts.items()}

    @property
    def ring_slots(self) -> int:
        """Slots of the ring of one arm."""
        seconds = self.stream.ring_seconds
        if seconds is None:
            return self.stream.ring_slots
        past = math.ceil(seconds * self.line_rate_hz / self.stream.block_lines) + 1
        return past + max(2, math.ceil(past / (RING_RESERVE_SHARE - 1)))

    @property
    def chunk_lines(self) -> int:
        """Lines per chunk of a recording. A block of some MB is one chunk: it is written without a copy."""
        if self.recording.chunk_lines is not None:
            return self.recording.chunk_lines
        line_bytes = self.geometry.stages * np.dtype(self.cameras.a.dtype).itemsize
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


def builtin_directory() -> Path:
    """The directory of the configurations that come with the program."""
    installed = Path(__file__).parent / "configs"
    return installed if installed.is_dir() else Path(__file__).parent.parent / "configs"


_MARKS = {"rig": {"geometry", "cameras", "trigger"}, "scene": {"kind"}, "plan": {"segments"}}
"""Keys by which a file shows what it describes."""
_USES = {
    "rig": "acquire serve --config {0}, or acquire simulate SCENE --config {0}",
    "scene": "acquire simulate {0} --out NAME.zarr",
    "plan": "acquire reconstruct RECORDING --plan {0} --out VIDEO.zarr",
}
"""The command that takes a file, by what it describes."""


def find(name: str | Path, beside: Path | None = None, kind: str = "") -> Path:
    """The file ``name``: as a path, beside another file, or a built-in one (with or without .toml).

    ``kind``, one of rig, scene and plan, chooses the built-in files that an error lists.
    """
    candidates = [Path(name)]
    if beside is not None:
        candidates.append(beside.parent / name)
    candidates += [builtin_directory() / name, builtin_directory() / f"{name}.toml"]
    for path in candidates:
        if os.path.isfile(path):  # noqa: PTH113  # Path's raises for a name that no file can have
            return path
    have = ", ".join(sorted(p.stem for p in builtin_directory().glob(f"{kind}*.toml")))
    if name and os.path.isdir(name):  # noqa: PTH112
        why = "is a directory"
    else:
        why = "is no regular file" if os.path.lexists(name) else "does not exist"
    what = f"{kind} file" if kind else "configuration file"
    raise ConfigError(f"{what} {shown(str(name))} {why}", possible=f"a path, or one of the built-in {have}")


def load_rig(name: str | Path, overrides: Mapping[str, Any] | None = None) -> RigConfig:
    """Read, override (dotted keys, as ``{"simulation.speed": 10}``) and validate a rig file.

    Relative paths of scenes and calibrations are resolved against the file.
    """
    path = find(name, kind="rig")
    table = _read(path)
    _check_kind(table, "rig", path)
    for key, value in (overrides or {}).items():
        _set(table, key, value)
    rig = _validate(RigConfig, table, path)
    if rig.calibration is not None:
        rig = rig.model_copy(update={"calibration": _beside(rig.calibration, path)})
    if not rig.needs_scene:
        return rig
    scene = find(rig.scene_file(), beside=path, kind="scene").resolve()
    return rig.model_copy(update={"simulation": rig.simulation.model_copy(update={"scene": str(scene)})})


def _beside(named: Path, file: Path) -> Path:
    """What a file names: from here on, or else from where the file is."""
    return named.resolve() if os.path.lexists(named) else (file.parent / named).resolve()


def check_directory(rig: RigConfig) -> None:
    """Raise ConfigError unless the directory for recordings is there."""
    directory = rig.recording.directory
    if not directory.is_dir():
        raise ConfigError(f"recording.directory: there is no directory {directory}", hint="create it first")


def parse_settings(settings: Sequence[str]) -> dict[str, Any]:
    """``["code.seed=7", "name='x'"]`` as overrides of `load_rig`; values are TOML."""
    overrides = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        try:
            overrides[key.strip()] = tomllib.loads(f"value = {value}")["value"]
        except (ValueError, RecursionError) as error:
            raise ConfigError(
                f"setting {shown(setting)}: {shortened(error)}"
                if equals
                else f"setting {shown(setting)} has no '='",
                possible="KEY=VALUE with a TOML value: code.seed=7, name='lab', cameras.a.serial='12'",
            ) from error
    return overrides


def load_scene(name: str | Path) -> SceneConfig:
    """Read and validate a scene file; a picture or video file is a scene that shows it.

    Relative paths in it are resolved against the file.
    """
    path = find(name, kind="scene")
    if path.suffix != ".toml":
        return VideoSceneConfig(kind="video", title=path.name, path=path.resolve())
    table = _read(path)
    _check_kind(table, "scene", path)
    return anchored(_validate(SceneFile, table, path).root, path.parent)


def load_plan(name: str | Path) -> ReconstructionPlan:
    """Read and validate the plan of a combinatorial reconstruction."""
    path = find(name, kind="plan")
    table = _read(path)
    _check_kind(table, "plan", path)
    return check_plan(table, path)


def check_plan(table: dict[str, Any], origin: str | Path) -> ReconstructionPlan:
    """The plan that a table describes; ``origin`` is where its mistakes are to be mended."""
    return _validate(ReconstructionPlan, table, Path(origin))


def _read(path: Path) -> dict[str, Any]:
    try:
        # Editors of some systems begin a file with a mark.
        text = read_regular(path, MOST_FILE_BYTES).decode("utf-8-sig")
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not TOML: byte {error.start} is not UTF-8") from error
    except RecursionError as error:
        raise ConfigError(f"{path} is not TOML: it is nested too deeply") from error
    except ValueError as error:  # that of a number with thousands of digits, too
        raise ConfigError(f"{path} is not TOML: {shortened(error, 400)}") from error
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error


def _check_kind(table: dict[str, Any], wanted: str, path: Path) -> None:
    """Raise ConfigError for a file that shows that it describes something else than what is ``wanted``."""
    found = [kind for kind, keys in _MARKS.items() if keys & table.keys()]
    if len(found) == 1 and found != [wanted]:
        raise ConfigError(
            f"{path} describes a {found[0]}, and a {wanted} was asked for",
            possible=f"a {wanted} file",
            hint=_USES[found[0]].format(path.stem if path.parent == builtin_directory() else path),
        )


def _set(table: dict[str, Any], dotted: str, value: Any) -> None:
    *parents, last = dotted.split(".")
    for key in parents:
        table = table.setdefault(key, {})
        if not isinstance(table, dict):
            raise ConfigError(f"setting {dotted!r}: {key!r} is a value, nothing is below it")
    table[last] = value


def _validate(model: type[M], table: dict[str, Any], path: Path) -> M:
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise ConfigError(explained(error, model, path)) from error
