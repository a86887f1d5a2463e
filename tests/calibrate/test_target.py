"""Orientation and alignment from a target at rest, and the corrections of lines that follow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments import COLUMNS, NOISE, N, S, columns_truth, dots, record, white
from scipy.ndimage import gaussian_filter, shift

from acquire.alignment import Alignment
from acquire.calibrate import Calibration, Measured, calibrated
from acquire.calibrate.check import check
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.exposure import instrument_of, open_exposure
from acquire.calibrate.orientation import MODEL, VIEWS, View, oriented
from acquire.calibrate.still import stills
from acquire.calibrate.target import alignment, orientation
from acquire.calibrate.words import found_facts
from acquire.errors import UsageError
from acquire.forward import DualArm
from acquire.sim.scenes import build_scene
from acquire.store import open_recording


def empty(path: Path) -> Calibration:
    return Calibration(instrument_of(open_recording(path)))


def test_each_arm_alone_shows_a_scene_at_rest(tmp_path: Path) -> None:
    scene = dots(tmp_path)
    path = record(tmp_path / "target.zarr", scene, "target", 256)
    picture = build_scene(scene, N, 1e-5).frames(0, 1)[0]
    boxed = np.stack([picture[max(0, m - S + 1) : m + 1].sum(axis=0) for m in range(N + S - 1)])
    a, b = stills(open_recording(path).cut(0, 256))
    np.testing.assert_allclose(a.image, boxed.reshape(N + S - 1, -1, S).sum(axis=2), atol=0.2)
    assert a.misfit < 1e-3
    turned = np.rot90(picture)
    boxed = np.stack([turned[max(0, m - S + 1) : m + 1].sum(axis=0) for m in range(N + S - 1)])
    np.testing.assert_allclose(b.image, boxed.reshape(N + S - 1, -1, S).sum(axis=2), atol=0.2)


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
def test_every_orientation_is_found_from_a_target(tmp_path: Path, view: View) -> None:
    optics = {"b": {"turn_deg": view.turn_deg, "mirror": view.mirrored}}
    path = record(tmp_path / "target.zarr", dots(tmp_path, NOISE, optics=optics), "target", 256)
    found = orientation(open_exposure(path), empty(path))
    assert found.orientation == view.name
    assert found.facts["ratio"] > 2
    assert bool(found.warnings) is not view.crosses


def test_orientation_is_relative_to_arm_a(tmp_path: Path) -> None:
    """A is turned by 90 degrees and B is not: the arms are swapped."""
    optics = {"a": {"turn_deg": 90}, "b": {"turn_deg": 0}}
    path = record(tmp_path / "target.zarr", dots(tmp_path, NOISE, optics=optics), "target", 256)
    assert orientation(open_exposure(path), empty(path)).orientation == "turn 270"


@pytest.mark.parametrize(
    ("level", "why"),
    [
        (0.0, "lines of arm a and b do not follow the light's code; switch"),
        (0.4, "nearly uniform, its brightness"),
    ],
    ids=["black", "white"],
)
def test_a_scene_without_texture_gives_no_orientation(tmp_path: Path, level: float, why: str) -> None:
    path = record(tmp_path / "plain.zarr", white(level, NOISE), "target", 256)
    found = orientation(open_exposure(path), empty(path))
    assert found.orientation is None
    assert found.warnings[0].startswith("the orientation is not clear: ")
    assert why in found.warnings[0]
    with pytest.raises(UsageError, match="does not determine the alignment"):
        alignment(open_exposure(path), empty(path))


@pytest.mark.parametrize("view", [view for view in VIEWS if view.crosses], ids=lambda view: view.name)
def test_lines_are_oriented(tmp_path: Path, view: View) -> None:
    """`oriented` gives Eq. (4) of the view of the camera that then comes first."""
    scene = dots(tmp_path, optics={"b": {"turn_deg": view.turn_deg, "mirror": view.mirrored}})
    path = record(tmp_path / "run.zarr", scene, "target", 80)
    segment = replace(open_recording(path).cut(0, 80), responsivity_dn=(8.0, 8.0))
    undo_turn = oriented(segment, view)
    picture = build_scene(scene, N, 1e-5).frames(0, 1)[0]
    swapped = view.swapped
    seen = view.seen(picture) if swapped else picture
    seen = seen[:, ::-1] if swapped and view.mirrored else seen
    video = np.broadcast_to(seen, (segment.geometry.span, N, N)).astype(np.float32)
    expected = DualArm(segment.geometry, segment.code).forward(np.ascontiguousarray(video))
    np.testing.assert_allclose(undo_turn.samples(), expected, atol=0.07)  # rounded to whole DN
    if view != MODEL:
        assert np.abs(segment.samples() - expected).max() > 1


def test_cameras_along_the_same_axis_are_refused(recordings: dict[str, Path]) -> None:
    segment = open_recording(recordings["target"]).cut(0, 80)
    with pytest.raises(UsageError, match="same axis"):
        oriented(segment, View(180, mirrored=False))


@pytest.mark.parametrize(
    "off",
    [
        {"rows": 0.3, "columns": -0.2},
        {"rows": -2.0, "columns": 1.3, "turn_deg": -0.6},
        {"rows": 4.0, "columns": -3.0, "turn_deg": 1.0},
    ],
)
def test_shift_and_turn_to_some_hundredths(tmp_path: Path, off: dict[str, float]) -> None:
    """With ordinary noise, uncorrected unequal columns, and a seventh of the paper's pixels."""
    effects = [*NOISE, {"kind": "prnu", "prnu": 0.01}, {"kind": "misregistration", **off}]
    path = record(tmp_path / "target.zarr", dots(tmp_path, effects), "target", 768)
    found = alignment(open_exposure(path), empty(path)).alignment
    assert found is not None
    assert found.alignment.rows == pytest.approx(off["rows"], abs=0.06)
    assert found.alignment.columns == pytest.approx(off["columns"], abs=0.06)
    assert found.alignment.turn_deg == pytest.approx(off.get("turn_deg", 0), abs=0.08)
    assert found.alignment.magnification == pytest.approx(1, abs=2e-3)
    for name in ("rows", "columns"):
        error = abs(found.alignment.facts()[name] - off[name])
        assert error < 8 * found.uncertainty[name]


@pytest.mark.parametrize("part", [0.03, -0.02])
def test_a_lens_that_distorts_arm_b_is_measured(tmp_path: Path, part: float) -> None:
    """Without it, the similarity that fits best leaves most of the arms' difference."""
    off = {"rows": 1.5, "columns": -1.0, "turn_deg": 0.4, "beyond": "edge"}
    lens = {"kind": "lens_distortion", "arm": "b", "part": part}
    scene = dots(tmp_path, [*NOISE, {"kind": "misregistration", **off}, lens])
    path = record(tmp_path / "target.zarr", scene, "target", 768)
    found = alignment(open_exposure(path), empty(path))
    assert found.alignment is not None
    at = found.alignment.alignment
    assert at.distortion == pytest.approx(part, abs=0.004)  # 0.14 fine pixels
    assert at.magnification == pytest.approx(1, abs=2e-3)
    assert at.rows == pytest.approx(1.5, abs=0.08)
    assert "outwards" in found_facts(found)["distorted"]
    picture = build_scene(scene, N, 1e-5).frames(0, 1)
    segment = replace(open_recording(path).cut(0, 256), alignment=at)

    def difference(arrangement: Alignment) -> float:
        operator = DualArm(segment.geometry, segment.code, 1, segment.geometry.span, alignment=arrangement)
        return float((segment.samples()[1] - operator.forward(picture)[1]).std())

    assert difference(at) < 0.7 * difference(replace(at, distortion=0.0, magnification=1 + at.distortion / 2))


def test_coinciding_lenses_have_no_distortion(recordings: dict[str, Path], known: Calibration) -> None:
    found = alignment(open_exposure(recordings["target"]), known)
    assert found.alignment is not None
    assert found.alignment.alignment.distortion == 0
    assert "distorted" not in found_facts(found)


def test_a_flat_that_ends_at_the_fields_edge_is_corrected(
    recordings: dict[str, Path], known: Calibration
) -> None:
    """Arm B sees beyond it: its share looks smaller, and its turn gives the gains a slope."""
    found = alignment(open_exposure(recordings["target"]), known)
    assert "light ends at the field's edge" in found.warnings[0]
    truth = columns_truth(white(effects=[COLUMNS[0]]))
    light = np.stack([truth[arm] - 20.0 for arm in ("a", "b")]) * np.array([[0.92], [1.08]])
    inner = slice(2, -2)

    def errors(quantities: Mapping[str, Measured]) -> tuple[float, float]:
        gain, balance = quantities["gain"].value[1, inner], quantities["balance"].value
        own, ratio = light[1, inner] / light[1, inner].mean(), light[1, inner].mean() / light[0, inner].mean()
        return float((gain / gain.mean() - own).std()), abs(balance[1] / balance[0] / ratio - 1)

    gain, balance = errors(known.quantities)
    assert gain > 0.0015
    assert balance > 0.01
    gain, balance = errors(found.quantities)
    assert gain < 0.001
    assert balance < 0.002


def test_a_flat_larger_than_the_field_is_unchanged(tmp_path: Path) -> None:
    off = {"kind": "misregistration", "rows": 1.5, "columns": -1.0, "turn_deg": 0.5, "beyond": "edge"}
    effects = [*NOISE, *COLUMNS, {"kind": "beam_splitter", "part_a": 0.46}, off]
    plain = white(effects=effects)
    scenes = {"dark": plain, "flat": plain, "target": dots(tmp_path, effects)}
    taken = {
        name: open_exposure(record(tmp_path / f"{name}.zarr", scene, name)) for name, scene in scenes.items()
    }
    first = dark(taken["dark"])
    calibration = Calibration(first.instrument).with_step(first)
    calibration = calibration.with_step(flat(taken["flat"], calibration))
    found = alignment(taken["target"], calibration)
    assert found.quantities == {}
    assert found.warnings == ()
    assert found.alignment is not None
    assert found.alignment.alignment.rows == pytest.approx(1.5, abs=0.06)


def test_light_on_the_common_field_corrects_the_balance(tmp_path: Path, known: Calibration) -> None:
    """The target shows that the splitter has moved since the flat."""
    effects = [*NOISE, *COLUMNS, {"kind": "beam_splitter", "part_a": 0.5}]
    path = record(tmp_path / "target.zarr", dots(tmp_path, effects), "target")
    found = alignment(open_exposure(path), known)
    balance = found.quantities["balance"].value
    assert balance[0] / 2 == pytest.approx(0.5, abs=0.004)
    assert "the balance is corrected" in found.warnings[0]


def test_another_orientation_than_known_is_refused(tmp_path: Path) -> None:
    path = record(
        tmp_path / "target.zarr", dots(tmp_path, NOISE, optics={"b": {"turn_deg": 270}}), "target", 256
    )
    with pytest.raises(UsageError, match="the known orientation"):
        alignment(open_exposure(path), empty(path))
    right = replace(empty(path), orientation="turn 270")
    found = alignment(open_exposure(path), right).alignment
    assert found is not None
    assert abs(found.alignment.rows) < 0.1


def test_recordings_without_an_image_are_refused(
    tmp_path: Path, recordings: dict[str, Path], known: Calibration
) -> None:
    with pytest.raises(UsageError, match="constant code"):
        orientation(open_exposure(recordings["flat"]), known)
    with pytest.raises(UsageError, match="complete lines do not determine an image"):
        orientation(open_exposure(recordings["target"], lines=80), known)


def test_dead_columns_are_left_out(tmp_path: Path, recordings: dict[str, Path], known: Calibration) -> None:
    usable = np.ones((2, N // S), bool)
    usable[0, [3, 17]] = usable[1, 8] = False
    holed = replace(known, usable=usable)
    segment = calibrated(open_recording(recordings["target"]).cut(0, 512), holed)
    assert not segment.mask[0, :, 3].any()
    assert segment.mask[0, :, 4].all()
    found = alignment(open_exposure(recordings["target"]), holed).alignment
    assert found is not None
    assert found.alignment.rows == pytest.approx(1.5, abs=0.06)


@pytest.mark.parametrize(
    "lens", [{"loss": 0.3}, {"loss": 0.4, "rows": 8.0, "columns": -6.0}, {"loss": 0.3, "arm": "b"}]
)
def test_a_lens_that_dims_the_edges_is_in_the_model(tmp_path: Path, lens: dict[str, Any]) -> None:
    """Gains alone would divide each arm by the profile across its own transfer, and make the arms differ."""
    off = {"kind": "misregistration", "rows": 0.6, "columns": -0.4, "beyond": "edge"}
    effects = [*NOISE, *COLUMNS, off, {"kind": "vignetting", **lens}]
    scenes = {"dark": white(effects=effects), "flat": white(effects=effects)}
    scene = dots(tmp_path, effects)
    taken = {name: record(tmp_path / f"{name}.zarr", each, name, 1024) for name, each in scenes.items()}
    taken["target"] = record(tmp_path / "target.zarr", scene, "target", 1024)
    first = dark(open_exposure(taken["dark"]))
    known = Calibration(first.instrument).with_step(first)
    known = known.with_step(flat(open_exposure(taken["flat"]), known))
    found = alignment(open_exposure(taken["target"]), known)
    assert "the light falls to" in " ".join(found.warnings)
    whole = known.with_step(found)
    picture = build_scene(scene, N, 1e-5).frames(0, 1)
    lines = open_recording(taken["target"]).cut(0, 256)

    def difference(calibration: Calibration) -> float:
        """Of the lines and the model of the true scene, up to a factor."""
        segment = calibrated(lines, calibration)
        operator = DualArm(
            segment.geometry,
            segment.code,
            1,
            segment.geometry.span,
            alignment=segment.alignment,
            blur=segment.blur,
        )
        model, samples = operator.forward(picture), segment.samples()
        return float((samples - model * (samples * model).sum() / (model**2).sum()).std() / samples.std())

    plain = {name: each for name, each in whole.quantities.items() if name != "shading"}
    assert difference(whole) < 0.8 * difference(replace(whole, quantities=plain))
    # a flat that is repeated has other gains, which the profile may not belong to
    again = replace(whole, steps={**whole.steps, "flat": {**whole.steps["flat"], "made": "2020-01-01T00:00"}})
    assert calibrated(lines, again).blur is None


def test_lenses_without_a_fall_of_light_have_none(recordings: dict[str, Path], known: Calibration) -> None:
    assert "shading" not in alignment(open_exposure(recordings["target"]), known).quantities


def moving(tmp_path: Path, pixels: float) -> Path:
    """A target that moves down by so many fine pixels while 512 lines are recorded."""
    scene = dots(tmp_path, NOISE)
    picture = np.load(scene.path)[0]
    steps = np.arange(32) * pixels / 32
    np.save(scene.path, np.stack([shift(picture, (step, 0), order=1) for step in steps]).astype(np.float32))
    table = scene.model_dump() | {"frame_rate_hz": 32 / (512 * S * 1e-5)}
    return record(tmp_path / "moving.zarr", type(scene).model_validate(table), "target")


def test_a_target_that_moved_is_reported(tmp_path: Path, recordings: dict[str, Path]) -> None:
    """It gave an alignment with an error of seven of its uncertainties, without a word."""
    path = record(tmp_path / "dark.zarr", white(effects=NOISE), "dark")
    first = dark(open_exposure(path))
    known = Calibration(first.instrument).with_step(first)
    exposure = open_exposure(moving(tmp_path, 1.0))
    found = alignment(exposure, known)
    assert "the target moved while it was recorded" in found.warnings[0]
    # A check with it called the instrument changed, without this doubt.
    still = open_exposure(recordings["target"])
    calibrated_once = known.with_step(orientation(still, known)).with_step(alignment(still, known))
    doubts = check(exposure, calibrated_once).doubts
    assert any("the target moved while it was recorded" in each for each in doubts), doubts
    assert not any("moved" in each for each in check(still, calibrated_once).doubts)


def test_a_target_out_of_focus_is_reported(tmp_path: Path, known: Calibration) -> None:
    scene = dots(tmp_path, NOISE)
    np.save(scene.path, gaussian_filter(np.load(scene.path), (0, 6, 6)))
    path = record(tmp_path / "blurred.zarr", scene, "target")
    found = alignment(open_exposure(path), known)
    assert any("coarse, or out of focus" in each for each in found.warnings)


def test_images_that_do_not_show_the_same_are_refused(
    monkeypatch: pytest.MonkeyPatch, recordings: dict[str, Path], known: Calibration
) -> None:
    """A target that moved by 30 fine pixels was aligned with a misfit of 74 %."""
    monkeypatch.setattr("acquire.calibrate.target.UNLIKE", 0.001)
    with pytest.raises(UsageError, match="do not show the same"):
        alignment(open_exposure(recordings["target"]), known)
