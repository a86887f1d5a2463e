"""Calibrate random instruments from three recordings each, and compare the result with their true properties.

Usage: python -m tools.bench_calibrate [--instruments 5] [--seed 1] [--lines 1024] [--no-video] [--json FILE]

Every instrument has shot noise, read noise, dark current, columns that differ in gain and offset, ambient
light, an uneven beam splitter, and an arm B that is shifted, rotated and magnified; every second one has a
point spread. Dark, flat and target are recorded with ``--lines`` lines each and calibrated as `acquire
calibrate all` does. The target (--target) is the sheet that `acquire calibrate sheet` draws, askew, with
black dark parts (sheet: also measures blur and veil), printed on paper, whose black reflects 4 % (paper: blur
only), unsharp itself by 0.5 fine pixels (soft), or random dots of 2 to 6 fine pixels (dots: neither). In
every second instrument the flat's light ends at the field's edge. Then a scene of three lamps of random
shapes, positions and frequencies is reconstructed from 263 lines (voxels 3 x 1): as recorded, calibrated,
with the instrument's true properties instead of measured ones (exact_db: what no better calibration would
exceed, but for chance), from lines with only the same noise, and from lines that also have the splitter's
unequal shares and the ambient light, exactly known (known_db): no calibration takes away the noise that these
add. Columns: errors of shift (fine pixels), rotation (degrees), DN per electron (%), gains and offsets in the
worst column that the optics do not hide (%, DN; gain_inner: without the outermost columns, where light lost
at the field's edge is mistaken for gain), the splitter (%), PSNR in dB, seconds.

--orientations draws 24 instruments instead (eight views of arm B, three targets each) and counts the answers.
--measured takes the instrument of configs/scene-leds-measured.toml and its four lamps instead, with arm B
displaced by three amounts; known_db has all effects but displacement and columns, of which only splitter and
dark level are known. --psf measures the optics' blur and veil from a fourth recording instead, of a
checkerboard whose dark squares are black. --cases chooses the videos.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from acquire.alignment import Alignment
from acquire.blur import Blur
from acquire.calibrate import Calibration, calibrated
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.exposure import instrument_of, open_exposure
from acquire.calibrate.orientation import VIEWS
from acquire.calibrate.psf import psf
from acquire.calibrate.sheet import Sheet
from acquire.calibrate.target import alignment, orientation
from acquire.calibrate.transfer import transfer
from acquire.calibrate.veil import veil
from acquire.config import load_rig, load_scene
from acquire.errors import UsageError
from acquire.forward import merge_video
from acquire.noise import Noise
from acquire.recon import reconstruct
from acquire.sim.leds import LedSceneConfig
from acquire.sim.media import VideoSceneConfig
from acquire.sim.scenes import build_scene
from acquire.simulate import bench_of, simulate
from acquire.store import open_recording
from tools.results import Run, add_option, recorded

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from acquire.config.scene import SceneConfig
    from acquire.lines import Segment

BLACK_DN = 40.0
K = 0.1
SEGMENT = 263
CASES = ("raw", "calibrated", "exact", "noise", "known")
TARGETS = ("sheet", "paper", "soft", "dots")
LIGHT = {"dark": 0, "flat": 1, "edges": None, "scene": None, **dict.fromkeys(TARGETS)}
SIZE, FINER = 192, 8
NOISE = ("shot_noise", "read_noise", "dark_current")
LIGHTS = ("beam_splitter", "stray_light")
DARK = ("prnu", "column_offsets", "stray_light", "beam_splitter", "dark_current")


@dataclass(frozen=True)
class Drawn:
    """One instrument."""

    seed: int
    part_a: float
    prnu: float
    ambient: float
    rows: float
    columns: float
    turn_deg: float
    magnification: float
    beyond: str
    blur: float
    code_seed: int

    known: ClassVar[tuple[str, ...]] = LIGHTS
    """Effects of the lines that a reconstruction would have after a perfect calibration."""

    @classmethod
    def at_random(cls, seed: int) -> Drawn:
        rng = np.random.default_rng(seed)
        far = float(rng.choice([0.4, 1.5, 6.0]))
        return cls(
            seed=seed,
            part_a=float(rng.uniform(0.44, 0.56)),
            prnu=float(rng.uniform(0.005, 0.02)),
            ambient=float(rng.uniform(0, 0.03)),
            rows=float(rng.uniform(-far, far)),
            columns=float(rng.uniform(-far, far)),
            turn_deg=float(rng.uniform(-0.6, 0.6)),
            magnification=float(1 + rng.uniform(-1, 1) * 2e-3),
            beyond=str(rng.choice(["dark", "edge"])),
            blur=float(rng.choice([0.0, rng.uniform(0.3, 0.7)])),
            code_seed=int(rng.integers(2**31)),
        )

    @property
    def effects(self) -> list[dict[str, Any]]:
        listed: list[dict[str, Any]] = [
            {
                "kind": "misregistration",
                "rows": self.rows,
                "columns": self.columns,
                "turn_deg": self.turn_deg,
                "magnification": self.magnification,
                "beyond": self.beyond,
            },
            {"kind": "beam_splitter", "part_a": self.part_a},
            {"kind": "stray_light", "ambient": self.ambient},
            {"kind": "prnu", "prnu": self.prnu},
            {"kind": "column_offsets", "sigma_dn": 1.5, "channels": 8},
            {"kind": "dark_current", "electrons_per_s": 2e4},
            {"kind": "shot_noise"},
            {"kind": "read_noise", "sigma_e": 25.0},
        ]
        return listed + ([{"kind": "psf", "sigma_pixels": self.blur}] if self.blur else [])

    def scene(self, kind: str, effects: list[dict[str, Any]], directory: Path) -> SceneConfig:
        common = {"seed": self.seed, "system_gain_dn_per_e": K, "effects": effects}
        if kind in PICTURES:
            path = directory / f"{kind}.npy"
            np.save(path, PICTURES[kind](self.seed))
            return VideoSceneConfig.model_validate({"kind": "video", "path": path, **common})
        leds = lamps(self.seed) if kind == "scene" else [lamp("all", "square", (0.5, 0.5, 1.0), level=0.2)]
        return LedSceneConfig.model_validate({"kind": "leds", "leds": leds, **common})

    def record(
        self, kind: str, directory: Path, lines: int, effects: list[dict[str, Any]] | None = None
    ) -> Path:
        path = directory / f"{kind}-{len(list(directory.iterdir()))}.zarr"
        scene = self.scene(kind, self.effects if effects is None else effects, directory)
        simulate(self.rig(kind), scene, path, lines)
        return path

    def rig(self, kind: str) -> Any:
        value = LIGHT[kind]
        code = (
            {"code.seed": self.code_seed} if value is None else {"code": {"kind": "constant", "value": value}}
        )
        black = {f"cameras.{arm}.black_level_dn": BLACK_DN for arm in "ab"}
        return load_rig("rig-demo", black | code)


DISPLACED = ((0.3, -0.2, 0.0), (1.5, -1.0, 0.3), (6.0, -4.0, 0.5))
"""Rows and columns (fine pixels) and degrees by which arm B is displaced in `AsMeasured`."""


@dataclass(frozen=True)
class AsMeasured(Drawn):
    """The instrument and the lamps of configs/scene-leds-measured.toml, with arm B displaced."""

    known: ClassVar[tuple[str, ...]] = ("pwm", "led_rise_fall", "trigger_jitter", "psf", "cti", *LIGHTS)

    @classmethod
    def displaced(cls, seed: int, rows: float, columns: float, turn_deg: float) -> AsMeasured:
        drawn = {**asdict(Drawn.at_random(seed)), "part_a": 0.48, "magnification": 1.0, "beyond": "dark"}
        return cls(**{**drawn, "rows": rows, "columns": columns, "turn_deg": turn_deg, "blur": 0.6})

    @property
    def effects(self) -> list[dict[str, Any]]:
        listed = [each.model_dump() for each in load_scene("scene-leds-measured").effects]
        moved = {"rows": self.rows, "columns": self.columns, "turn_deg": self.turn_deg}
        return [each | moved if each["kind"] == "misregistration" else each for each in listed]

    def scene(self, kind: str, effects: list[dict[str, Any]], directory: Path) -> SceneConfig:
        if kind != "scene":
            return super().scene(kind, effects, directory)
        table = load_scene("scene-leds-measured").model_dump() | {"seed": self.seed, "effects": effects}
        return LedSceneConfig.model_validate(table)


def lamp(
    name: str, shape: str, place: tuple[float, float, float], *, level: float = 1.0, hertz: float = 0.0
) -> Any:
    row, column, size = place
    drive: dict[str, Any] = {"waveform": "constant", "level": level}
    if hertz:
        drive = {"waveform": "sine", "frequency_hz": hertz, "low": 0.05, "high": 1.0}
    return {"name": name, "shape": shape, "row": row, "column": column, "size": size, "drive": drive}


def lamps(seed: int) -> list[Any]:
    rng = np.random.default_rng(seed + 1000)
    shapes, corners = rng.permutation(["x", "triangle", "circle", "equals"]), rng.permutation(4)
    return [
        lamp(
            f"lamp {k}",
            str(shapes[k]),
            (
                0.28 + 0.44 * (corners[k] // 2) + float(rng.uniform(-0.05, 0.05)),
                0.28 + 0.44 * (corners[k] % 2) + float(rng.uniform(-0.05, 0.05)),
                float(rng.uniform(0.25, 0.38)),
            ),
            hertz=float(rng.uniform(500, 6000)),
        )
        for k in range(3)
    ]


def dots(seed: int) -> NDArray[np.float32]:
    rng, n = np.random.default_rng(seed + 2000), 192
    picture = np.zeros((1, n, n), np.float32)
    for _ in range(450):
        side = int(rng.integers(2, 7))
        row, column = rng.integers(0, n - side, 2)
        picture[0, row : row + side, column : column + side] = 1
    return picture


def checkerboard(seed: int) -> NDArray[np.float32]:
    """A turned checkerboard with squares of about 58 fine pixels; pixels hold the mean over their area."""
    angle = np.deg2rad(np.random.default_rng(seed + 4000).uniform(3, 20))
    at = (np.arange(SIZE * FINER) + 0.5) / FINER - SIZE / 2
    y, x = np.meshgrid(at, at, indexing="ij")
    u, v = y * np.cos(angle) + x * np.sin(angle), x * np.cos(angle) - y * np.sin(angle)
    squares = (np.floor(3.3 * u / SIZE) + np.floor(3.3 * v / SIZE)) % 2
    means = squares.reshape(SIZE, FINER, SIZE, FINER).mean(axis=(1, 3))
    return np.asarray(means, np.float32)[None]


def sheet(seed: int, *, dark: float = 0.0, soft: float = 0.0) -> NDArray[np.float32]:
    """The sheet of `acquire calibrate sheet`, askew by up to 3 degrees and 20 fine pixels off."""
    rng = np.random.default_rng(seed + 5000)
    turn, (down, right) = float(rng.uniform(-3, 3)), rng.uniform(-20, 20, 2).tolist()
    picture = Sheet(3).picture(SIZE, (down, right), turn)
    picture = gaussian_filter(picture, soft, mode="nearest") if soft else picture
    return np.asarray(dark + (1 - dark) * picture, np.float32)[None]


PICTURES: dict[str, Callable[[int], NDArray[np.float32]]] = {
    "sheet": sheet,
    "paper": partial(sheet, dark=0.04),
    "soft": partial(sheet, soft=0.5),
    "dots": dots,
    "edges": checkerboard,
}
"""What is in front of the lenses; printed black on paper reflects 3 to 5 % of the light."""


def calibrate(
    drawn: Drawn, directory: Path, lines: int, *, blur: bool = False, target: str = "dots"
) -> Calibration:
    """Dark, flat, transfer, orientation, alignment, and what else the target shows.

    ``blur``: the optics' blur and veil from a checkerboard of their own.
    """
    taken = {kind: open_exposure(drawn.record(kind, directory, lines)) for kind in ("dark", "flat", target)}
    first = dark(taken["dark"])
    known = Calibration(first.instrument).with_step(first)
    known = known.with_step(flat(taken["flat"], known))
    known = known.with_step(transfer([taken["flat"]], known))
    known = known.with_step(orientation(taken[target], known))
    known = known.with_step(alignment(taken[target], known))
    # as `acquire calibrate all` does, with --black if the dark parts are black
    for step in () if blur else (psf, veil) if target in ("sheet", "soft") else (psf,):
        try:
            known = known.with_step(step(taken[target], known))
        except UsageError as error:
            print(f"    {target}: {error.message}")
    if not blur:
        return known
    edges = open_exposure(drawn.record("edges", directory, lines))
    known = known.with_step(psf(edges, known))
    return known.with_step(veil(edges, known))


def compared(drawn: Drawn, known: Calibration, directory: Path) -> dict[str, float]:
    """Differences between the calibration and the true properties."""
    found = known.alignment
    assert found is not None
    at, K_found = found.alignment, known.quantities["dn_per_electron"].value
    gain, offset = known.quantities["gain"].value, known.quantities["offset_dn"].value
    own = fixed(drawn, "flat", ("prnu",), directory) - BLACK_DN
    hidden = np.zeros(gain.shape, bool)
    for arm, columns in known.steps["flat"]["optics_hide_columns"].items():
        hidden["ab".index(arm), columns] = True
    gains = np.where(hidden, 1.0, gain)
    level = [row[~out].mean() for row, out in zip(own, hidden, strict=True)]
    errors = np.where(hidden, 0.0, gains - own / np.array(level)[:, None])
    errors -= np.array([row[~out].mean() for row, out in zip(errors, hidden, strict=True)])[:, None]
    errors[hidden] = 0
    inner = errors[:, 1:-1][~hidden[:, 1:-1]]
    balance = known.quantities["balance"].value
    truth = np.array([drawn.part_a, 1 - drawn.part_a]) * np.array(level)
    dark_truth = fixed(drawn, "dark", DARK, directory)
    return {
        "shift_px": float(np.hypot(at.rows - drawn.rows, at.columns - drawn.columns)),
        "turn_deg": abs(at.turn_deg - drawn.turn_deg),
        "magnification": abs(at.magnification - drawn.magnification),
        "dn_per_e_percent": 100 * float(np.abs(K_found / K - 1).max()),
        "gain_percent": 100 * float(np.abs(errors).max()),
        "gain_inner_percent": 100 * float(np.abs(inner - inner.mean()).max()),
        "offset_dn": float(np.abs(offset - dark_truth).max()),
        "splitter_percent": 100 * abs(float(balance[0] / balance.sum() / (truth[0] / truth.sum()) - 1)),
    }


def fixed(drawn: Drawn, kind: str, kinds: tuple[str, ...], directory: Path) -> NDArray[np.float64]:
    """Mean DN of every column with these effects only, (arm, column); rounding averages out over lines."""
    listed = [effect for effect in drawn.effects if effect["kind"] in kinds]
    listed.append({"kind": "read_noise", "sigma_e": 25.0})
    rig = drawn.rig(kind)
    bench = bench_of(rig, drawn.scene(kind, listed, directory))
    code = rig.code.build()
    return np.stack(
        [bench.camera(arm, code).read(64, 65536).pixels.mean(axis=0, dtype=np.float64) for arm in "ab"]
    )


def pictures(
    drawn: Drawn, known: Calibration, directory: Path, wanted: Sequence[str] = CASES
) -> dict[str, float]:
    """PSNR of the reconstructed lamps: as recorded, calibrated, in an exact model, and with noise only."""
    noise = [effect for effect in drawn.effects if effect["kind"] in NOISE]
    light = [effect for effect in drawn.effects if effect["kind"] in (*NOISE, *drawn.known)]
    paths = {
        "raw": drawn.record("scene", directory, 400),
        "noise": drawn.record("scene", directory, 400, noise),
        "known": drawn.record("scene", directory, 400, light),
    }
    cuts = {name: open_recording(path).cut(70, SEGMENT) for name, path in paths.items()}
    cases = {
        "raw": cuts["raw"],
        "calibrated": calibrated(cuts["raw"], known),
        "exact": exact(drawn, cuts["raw"], directory),
        "noise": cuts["noise"],
        "known": replace(
            cuts["known"],
            black_level_dn=fixed(drawn, "dark", (*drawn.known, "dark_current"), directory),
            responsivity_dn=np.repeat([[2 * drawn.part_a], [2 - 2 * drawn.part_a]], 64, 1)
            * np.asarray(cuts["known"].responsivity_dn),
            balanced=True,
        ),
    }
    scene = build_scene(drawn.scene("scene", [], directory), 192, 1e-5)
    truth = merge_video(scene.frames(3 * 70, cuts["raw"].geometry.span), 3, 1)
    found = {}
    for name in wanted:
        segment, began = cases[name], time.perf_counter()
        found[f"{name}_db"] = _psnr(segment, truth)
        found[f"{name}_s"] = time.perf_counter() - began
    return found


def exact(drawn: Drawn, segment: Segment, directory: Path) -> Segment:
    """The segment with the instrument's true properties, as far as a calibration has them."""
    effects = {effect["kind"]: effect for effect in drawn.effects}
    part_a, veil = effects["beam_splitter"]["part_a"], effects["stray_light"].get("veil", 0.0)
    flats = [fixed(drawn, "flat", kinds, directory) - BLACK_DN for kinds in (("prnu",), ())]
    gain = flats[0] / flats[1] * np.array([[2 * part_a], [2 - 2 * part_a]])
    sigma = effects["psf"]["sigma_pixels"] if "psf" in effects else 0.0
    # the simulated kernel is sampled at whole pixels, which changes its width
    spread = gaussian_filter1d(np.eye(1, 129, 64)[0], sigma) if sigma else np.eye(1, 129, 64)[0]
    width = float(np.sqrt((spread * np.arange(-64, 65) ** 2).sum()))
    return replace(
        segment,
        black_level_dn=fixed(drawn, "dark", DARK, directory),
        responsivity_dn=gain * np.asarray(segment.responsivity_dn),
        balanced=True,
        alignment=Alignment(drawn.rows, drawn.columns, drawn.turn_deg, drawn.magnification),
        blur=Blur((width, width), (width, width), veil=(veil, veil)) if width or veil else None,
        noise=Noise((K, K), (25.0 * K, 25.0 * K)),
    )


def _psnr(segment: Segment, truth: NDArray[np.float32]) -> float:
    result = reconstruct(segment, 3, 1)
    at = result.trusted
    return float(10 * np.log10(truth[at].max() ** 2 / np.mean((result.video[at] - truth[at]) ** 2)))


def orientations(seed: int, lines: int, run: Run) -> None:
    """24 instruments: eight views of arm B, three targets each."""
    right = wrong = undetermined = 0
    for number, view in enumerate(VIEWS * 3):
        drawn = Drawn.at_random(seed + number)
        optics = {"b": {"turn_deg": view.turn_deg, "mirror": view.mirrored}}
        with tempfile.TemporaryDirectory() as name:
            directory = Path(name)
            scene = drawn.scene("dots", drawn.effects, directory).model_copy(
                update={
                    "optics": VideoSceneConfig.model_validate(
                        {"kind": "video", "path": "x", "optics": optics}
                    ).optics
                }
            )
            path = directory / "target.zarr"
            simulate(drawn.rig("dots"), scene, path, lines)
            recording = open_recording(path)
            found = orientation(open_exposure(path), Calibration(instrument_of(recording)))
        right += found.orientation == view.name
        undetermined += found.orientation is None
        wrong += found.orientation not in (None, view.name)
        print(f"{view.name:20} found {found.orientation!s:20} ratio {found.facts['ratio']:.2f}", flush=True)
    print(f"{right} right, {undetermined} undetermined, {wrong} wrong")
    run.add("orientations", right=right, undetermined=undetermined, wrong=wrong)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--instruments", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lines", type=int, default=1024)
    parser.add_argument("--no-video", action="store_true")
    parser.add_argument("--orientations", action="store_true")
    parser.add_argument("--measured", action="store_true")
    parser.add_argument("--psf", action="store_true")
    parser.add_argument("--target", choices=TARGETS, default="sheet")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES)
    parser.add_argument("--json", type=Path)
    add_option(parser)
    options = parser.parse_args()
    with recorded("bench_calibrate", keep=options.record) as run:
        if options.orientations:
            orientations(options.seed, options.lines, run)
        else:
            instruments(options, run)


def instruments(options: argparse.Namespace, run: Run) -> None:
    """Calibrate random instruments, and print the worst value of each figure."""
    rows = []
    if options.measured:
        chosen: list[Drawn] = [AsMeasured.displaced(options.seed, *each) for each in DISPLACED]
    else:
        chosen = [Drawn.at_random(options.seed + number) for number in range(options.instruments)]
    for number, drawn in enumerate(chosen):
        with tempfile.TemporaryDirectory() as name:
            began = time.perf_counter()
            known = calibrate(drawn, Path(name), options.lines, blur=options.psf, target=options.target)
            row = {"calibration_s": time.perf_counter() - began, **compared(drawn, known, Path(name))}
            if not options.no_video:
                row |= pictures(drawn, known, Path(name), options.cases)
        rows.append({"instrument": asdict(drawn), **row})
        where = f"{drawn.rows:+.2f}/{drawn.columns:+.2f} px {drawn.turn_deg:+.2f} deg {drawn.beyond}"
        where += f" psf {drawn.blur:.2f}"
        print(
            f"{options.seed + number:3} {where:44} " + "  ".join(f"{k} {v:.4g}" for k, v in row.items()),
            flush=True,
        )
        run.add(f"seed {options.seed + number}", **row)
    worst = {key: max(row[key] for row in rows) for key in rows[0] if key != "instrument"}
    print("worst " + "  ".join(f"{key} {value:.4g}" for key, value in worst.items()))
    run.add("the largest of each", **worst)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
