"""From a scene file to the lines of a camera: the bare forward model plus only the listed stages.

::

    code, drives ─▶ [light] ─▶ ┐
                               ├─▶ Eq. (1) ─▶ [signal] ─▶ K⁻¹ ─▶ [charge] ─▶ K ─▶ [readout] ─▶ DN ─▶ [stream]
    scene ─▶ [image] ────────▶ ┘

The stages in brackets come from `acquire.sim.effects`. With none listed, `ArmSensor.read` is Eq. (1), a
factor, an offset and a rounding. The layouts differ in the sensor: ``compact`` has two images side by side on
one sensor, ``emulated`` a sensor of M·S stages whose raw lines are merged S × S, ``interline`` a coarse
sensor under the fine scene. Behind a fibre (`acquire.fibre`) the scene is drawn as a square that contains the
fibre's field; effects act on that image, and the field is then laid out on the sensor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.config.scene import OpticsConfig
from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.plugins import EFFECTS, SCENES, of_others
from acquire.sim.effects import in_order
from acquire.sim.effects.base import TILE_LINES, Setting, Stage
from acquire.sim.light import Illumination
from acquire.sim.lines import StreamingArm
from acquire.sim.optics import binned, mapped
from acquire.sim.readout import Readout
from acquire.sim.scenes import build_scene

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.config import GeometryConfig
    from acquire.config.device import CameraConfig
    from acquire.config.scene import SceneConfig
    from acquire.fibre import Fibre
    from acquire.plugins import Group
    from acquire.sim.scene import Scene
    from acquire.sim.stopwatch import Stopwatch


@dataclass(frozen=True, slots=True)
class Converter:
    """DN = clip(round(black level + responsivity · Y), 0, white), as ``dtype``."""

    white_dn: int
    black_level_dn: float
    responsivity_dn: float
    dtype: str

    @classmethod
    def of(cls, camera: CameraConfig) -> Converter:
        return cls(camera.white_dn, camera.black_level_dn, camera.responsivity_dn, camera.dtype)

    def convert(self, light: NDArray[Any]) -> NDArray[Any]:
        """Convert Y of Eq. (1) to DN."""
        return self.round(light * np.float32(self.responsivity_dn) + np.float32(self.black_level_dn))

    def round(self, dn: NDArray[Any]) -> NDArray[Any]:
        """Round DN to integers and clip them to the range."""
        pixels: NDArray[Any] = np.clip(np.rint(dn), 0, self.white_dn).astype(self.dtype)
        return pixels


@dataclass(frozen=True, slots=True)
class Bench:
    """Everything that a simulated camera depends on, most of it from the scene file. Picklable."""

    scene: SceneConfig
    geometry: GeometryConfig
    cameras: dict[str, CameraConfig]
    substep_s: float
    realisation: int = 0
    stopwatch: Stopwatch | None = None
    settled_s: Mapping[str, float] = field(default_factory=dict)
    """Arm → time (s) by which the trigger starts the charge transfers after the light; absent: 0."""
    lit_part: tuple[float, float] = (0.0, 1.0)
    """Begin and end of the light within a lit sub-step, as fractions of it, as the trigger sets them."""
    fibre: Fibre | None = None

    def without(self, *effects: str) -> Bench:
        """Return the same bench without some of its effects."""
        kept = tuple(effect for effect in self.scene.effects if effect.kind not in effects)
        return replace(self, scene=self.scene.model_copy(update={"effects": kept}))

    def camera(self, arm: str, code: Code) -> ArmSource:
        """Return the camera of ``arm`` under a code. Raises UsageError for an impossible combination."""
        optics = self.scene.optics
        converter = Converter.of(self.cameras[arm])
        if self.fibre is not None:
            if optics != OpticsConfig():
                raise UsageError(
                    "the scene has [optics] of its own, which cannot be combined with the rig's fibre",
                    possible="a scene without [optics]; or a rig without [fibre]",
                )
            return _sensor(
                self, arm, code, converter=converter, columns={arm: 0}, pixels=self.fibre.sensor_pixels
            )
        match optics.layout:
            case "emulated":
                return _emulated(self, arm, code, converter)
            case "compact":
                return _compact(self, arm, code, converter)
            case _:
                return _sensor(
                    self, arm, code, converter=converter, columns={arm: 0}, pixels=self.geometry.stages
                )

    def fine_scene(self, *, every_frame: bool = True) -> Scene:
        """Return the scene at the finest resolution that the cameras use, in camera A's rows and columns."""
        size = self.geometry.stages * self.geometry.substeps if self.fibre is None else self.fibre.side
        if self.scene.optics.layout != "interline":
            return build_scene(self.scene, size, self.substep_s, every_frame=every_frame)
        if self.geometry.substeps != 1:
            raise UsageError(
                f"layout 'interline' cannot have S = {self.geometry.substeps}",
                possible="geometry.substeps = 1",
            )
        factor = self.scene.optics.baseline_factor
        return build_scene(self.scene, size * factor, self.substep_s / factor, every_frame=every_frame)

    def summed_scene(self) -> Scene:
        """Return the light that Eq. (1) sums, in the pixels and sub-steps of a reconstruction."""
        scene, optics = self.fine_scene(), self.scene.optics
        return scene if optics.layout != "interline" else binned(scene, optics.baseline_factor)


class ArmSource(ABC):
    """The source of one arm's lines; see `Bench.camera`."""

    stages: tuple[Stage, ...]

    @abstractmethod
    def read(self, first_line: int, count: int) -> Readout:
        """Return ``count`` lines from ``first_line`` on."""


class ArmSensor(ArmSource):
    """One sensor with one image, or two side by side."""

    def __init__(
        self, images: Sequence[_Image], pixels: int, stages: Sequence[Stage], setting: Setting, dtype: str
    ) -> None:
        self.stages = tuple(stages) + tuple(stage for image in images for stage in image.stages)
        self._images, self._pixels = images, pixels
        self._converter = Converter(setting.white_dn, setting.black_level_dn, setting.responsivity_dn, dtype)
        self._gain = setting.gain_dn_per_e
        self._by_place = {
            place: [s for s in stages if s.place == place] for place in ("charge", "readout", "stream")
        }
        # Without such effects no line depends on others or on draws, and no whole tile has to be computed.
        self._pointwise = not any(self._by_place.values())
        self._tiles: dict[int, Readout] = {}

    def read(self, first_line: int, count: int) -> Readout:
        """Return lines ``first_line .. first_line + count - 1``; numbers below 0 are preroll."""
        if self._pointwise:
            pixels = self._converter.convert(self._expected(first_line, count))
            return Readout(pixels, np.zeros(count, np.bool_))
        tiles = range(first_line // TILE_LINES, (first_line + count - 1) // TILE_LINES + 1)
        parts = [self._tile(index) for index in tiles]
        inside = slice(first_line % TILE_LINES, first_line % TILE_LINES + count)
        pixels = np.concatenate([part.pixels for part in parts])[inside]
        return Readout(pixels, np.concatenate([part.missing for part in parts])[inside])

    def _expected(self, first_line: int, count: int) -> NDArray[Any]:
        """Return Y of every pixel of the sensor, including the effects on the signal."""
        if len(self._images) == 1 and self._images[0].column == 0:
            return self._images[0].lines(first_line, count)
        lines = np.zeros((count, self._pixels), np.float32)
        for image in self._images:
            part = image.lines(first_line, count)
            lines[:, image.column : image.column + part.shape[1]] = part
        return lines

    def _tile(self, index: int) -> Readout:
        """Return a tile of lines as delivered, after the effects on the stream.

        Tiles lie at fixed positions, so that the draws of an effect do not depend on the split into calls.
        """
        if index not in self._tiles:
            pixels, missing = self._digital(index), np.zeros(TILE_LINES, np.bool_)
            for stage in self._by_place["stream"]:
                pixels, lost = stage.run(pixels, index * TILE_LINES, lambda: self._digital(index - 1)[-1:])
                missing = missing if lost is None else missing | lost
            tile = Readout(np.where(missing[:, None], 0, pixels).astype(pixels.dtype), missing)
            # The last two are kept: a block of lines may begin in one tile and end in the next.
            self._tiles = {key: self._tiles[key] for key in list(self._tiles)[-1:]} | {index: tile}
        return self._tiles[index]

    def _digital(self, index: int) -> NDArray[Any]:
        """Return a tile of lines as converted, before the effects on the stream."""
        first_line, light = index * TILE_LINES, self._expected(index * TILE_LINES, TILE_LINES)
        # the responsivity is DN per unit of light, the gain DN per electron
        electrons = light.astype(np.float64) * (self._converter.responsivity_dn / self._gain)
        for stage in self._by_place["charge"]:
            electrons = stage.run(electrons, first_line)
        dn = electrons * self._gain + self._converter.black_level_dn
        for stage in self._by_place["readout"]:
            dn = stage.run(dn, first_line)
        return self._converter.round(dn)


class Merged(ArmSource):
    """Raw lines of a sensor without sub-steps, merged S × S in the digital domain (Sect. 5.1).

    A merged sample is white if any of its raw samples is.
    """

    def __init__(self, raw: ArmSensor, raw_white_dn: int, substeps: int, converter: Converter) -> None:
        self.stages = raw.stages
        self._raw, self._raw_white_dn, self._substeps, self._converter = (
            raw,
            raw_white_dn,
            substeps,
            converter,
        )

    def read(self, first_line: int, count: int) -> Readout:
        """Return lines; line ℓ of Eq. (1) is the sum of raw lines S·ℓ … S·ℓ + S − 1 over S columns each."""
        S = self._substeps
        raw = self._raw.read(S * first_line, S * count)
        blocks = raw.pixels.reshape(count, S, -1, S)
        # The sum of S² samples of 16 bits does not fit into their own type.
        merged = blocks.sum(axis=(1, 3), dtype=np.uint32)
        # a raw sample that is full has lost light, which its sum would not show
        white = blocks.max(axis=(1, 3)) >= self._raw_white_dn
        missing: NDArray[np.bool_] = np.any(raw.missing.reshape(count, S), axis=1)
        pixels = np.where(white, self._converter.white_dn, merged) * ~missing[:, None]
        return Readout(pixels.astype(self._converter.dtype), missing)


class Cut(ArmSource):
    """A range of columns of a sensor."""

    def __init__(self, sensor: ArmSensor, columns: slice) -> None:
        self.stages = sensor.stages
        self._sensor, self._columns = sensor, columns

    def read(self, first_line: int, count: int) -> Readout:
        """Return these columns of the sensor's lines."""
        lines = self._sensor.read(first_line, count)
        return Readout(np.ascontiguousarray(lines.pixels[:, self._columns]), lines.missing)


class _Image:
    """Expected lines of one arm on a sensor, including the effects on its signal."""

    def __init__(self, arm: StreamingArm, stages: Sequence[Stage], column: int) -> None:
        self.stages, self.column = stages, column
        self._arm = arm
        self._signal = [stage for stage in stages if stage.place == "signal"]
        self._lead = sum(stage.lead for stage in self._signal)
        self._recent: dict[int, NDArray[np.float32]] = {}

    def lines(self, first_line: int, count: int) -> NDArray[Any]:
        lines: NDArray[Any]
        if self._lead:
            # The effects need ``lead`` more lines before these. The last tiles are kept for the next call.
            first = first_line - self._lead
            tiles = range(first // TILE_LINES, (first_line + count - 1) // TILE_LINES + 1)
            for index in tiles:
                if index not in self._recent:
                    self._recent[index] = self._arm.lines(index * TILE_LINES, TILE_LINES)
            begin = first % TILE_LINES
            lines = np.concatenate([self._recent[index] for index in tiles])
            lines = lines[begin : begin + self._lead + count].astype(np.float64)
            # with a lead of less than a tile, the next lines and those before them begin in one of these
            self._recent = {index: self._recent[index] for index in tiles[-3:]}
        else:
            lines = self._arm.lines(first_line, count)
        for stage in self._signal:
            lines = stage.run(lines, first_line)
        return lines


def describe(scene: SceneConfig) -> dict[str, Any]:
    """Return the scene as stored in its recording, with the effects in the order in which they act (JSON)."""
    effects = [effect.model_dump(mode="json") for effect in in_order(scene.effects)]
    return {
        "simulated": True,
        "scene": scene.model_dump(mode="json"),
        "effects": effects,
        "plugins": of_others([*_scene_kinds(scene), *((EFFECTS, each.kind) for each in scene.effects)]),
    }


def _scene_kinds(scene: SceneConfig) -> Iterator[tuple[Group, str]]:
    yield SCENES, scene.kind
    for part in getattr(scene, "parts", ()):  # of a sum of scenes
        yield from _scene_kinds(part)


def _sensor(
    bench: Bench,
    name: str,
    code: Code,
    *,
    converter: Converter,
    columns: dict[str, int],
    pixels: int,
    merge: int = 1,
) -> ArmSensor:
    """Return a sensor with the images of the arms in ``columns`` (arm → first column)."""
    # The frames of other distributions' scenes are checked by camera A, at 2 % of the two cameras' time.
    geometry, scene = bench.geometry, bench.fine_scene(every_frame=name != "b")
    setting = Setting(
        arm=name,
        seed=bench.scene.seed,
        realisation=bench.realisation,
        # an emulated camera has M·S stages, and moves its charge once per line
        stages=geometry.stages * merge,
        substeps=geometry.substeps // merge,
        pixels=pixels,
        substep_s=bench.substep_s,
        scene=scene,
        white_dn=converter.white_dn,
        black_level_dn=converter.black_level_dn,
        responsivity_dn=converter.responsivity_dn,
        gain_dn_per_e=bench.scene.system_gain_dn_per_e,
        # On the one sensor of both arms ("ab"), the delay of camera A applies.
        settled_s=bench.settled_s.get(name[0], 0.0),
        lit_part=bench.lit_part,
        fibre=bench.fibre,
    )
    stages = _stages(bench, setting)
    images = []
    for arm, column in columns.items():
        # On a shared sensor each image has the optics of its own arm; the rest of the camera is common.
        own = stages if arm == name else _stages(bench, replace(setting, arm=arm))
        images.append(
            _image(bench.scene.optics, arm, column, code=code, setting=setting, common=stages, own=own)
        )
    kept = [stage for stage in stages if stage.place not in ("image", "signal")]
    return ArmSensor(images, pixels, kept, setting, converter.dtype)


def _stages(bench: Bench, setting: Setting) -> list[Stage]:
    """Return the stages of the listed effects, timed if the bench has a stopwatch."""
    if not bench.scene.effects:
        return []
    from acquire.sim.effects import build_stages

    stages = build_stages(bench.scene.effects, setting)
    return stages if bench.stopwatch is None else [bench.stopwatch.stage(stage) for stage in stages]


def _image(
    optics: OpticsConfig,
    arm: str,
    column: int,
    *,
    code: Code,
    setting: Setting,
    common: Sequence[Stage],
    own: Sequence[Stage],
) -> _Image:
    """Return the expected lines of ``arm``.

    Effects on the light are ``common`` to the images of a sensor; those on image and signal are its ``own``.
    """
    factor = optics.baseline_factor if optics.layout == "interline" else 1
    scene = setting.scene
    light = Illumination.of(scene if factor == 1 else binned(scene, factor), code)
    for stage in common:
        light = stage.run(light) if stage.place == "light" else light
    # after the effects, which are those of the sources: the trigger's window only shortens what they emit
    light = light.on_for(setting.lit_part[1] - setting.lit_part[0])
    for stage in own:
        scene = mapped(scene, stage.run) if stage.place == "image" else scene
    scene = scene if factor == 1 else binned(scene, factor)
    own_optics = getattr(optics, arm)
    streaming = StreamingArm(
        scene,
        light,
        stages=setting.stages,
        substeps=setting.substeps,
        arm=arm,
        optics=own_optics,
        fibre=setting.fibre,
    )
    return _Image(streaming, [stage for stage in own if stage.place in ("image", "signal")], column)


def _compact(bench: Bench, arm: str, code: Code, converter: Converter) -> Cut:
    """Return an arm's columns of the one sensor that both arms share."""
    optics, M = bench.scene.optics, bench.geometry.stages
    first = {"a": optics.column_a, "b": optics.column_b}
    if first["b"] is None:
        first["b"] = optics.sensor_pixels // 2
    columns = {name: int(first[name] or 0) for name in ARMS}
    low, high = sorted(columns.values())
    if high < low + M or high + M > optics.sensor_pixels:
        raise UsageError(
            f"a compact layout cannot have images of {M} columns at {columns['a']} and {columns['b']}",
            possible=f"two ranges side by side on {optics.sensor_pixels} columns",
        )
    if converter != Converter.of(bench.cameras["b"]) or converter != Converter.of(bench.cameras["a"]):
        raise UsageError(
            "a compact layout cannot have two different cameras",
            possible="equal cameras.a and cameras.b, since the layout has one camera",
        )
    sensor = _sensor(bench, "ab", code, converter=converter, columns=columns, pixels=optics.sensor_pixels)
    return Cut(sensor, slice(columns[arm], columns[arm] + M))


def _emulated(bench: Bench, arm: str, code: Code, converter: Converter) -> Merged:
    """Return a camera of M·S stages whose raw lines are merged S × S."""
    S = bench.geometry.substeps
    raw_white = (1 << bench.scene.optics.raw_bits) - 1
    if raw_white * S**2 > converter.white_dn:
        raise UsageError(
            f"layout 'emulated': {S} x {S} samples of {bench.scene.optics.raw_bits} bits do not fit into "
            f"lines up to {converter.white_dn} DN",
            possible="cameras with a wider pixel_format, such as Mono16, or fewer optics.raw_bits",
        )
    # S² raw samples are added up, and with them their black levels.
    raw = replace(
        converter, white_dn=raw_white, black_level_dn=converter.black_level_dn / S**2, dtype="uint16"
    )
    n = bench.geometry.stages * S
    return Merged(
        _sensor(bench, arm, code, converter=raw, columns={arm: 0}, pixels=n, merge=S), raw_white, S, converter
    )
