"""The optics' blur from slanted edges: measured or refused, and in the model only if it is clear."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments import NOISE, dots, record

import acquire.calibrate.psf as method
from acquire.alignment import Alignment
from acquire.blur import Blur
from acquire.calibrate import AlignmentFound, Calibration, Measured, calibrated
from acquire.calibrate.apply import blur_of
from acquire.calibrate.check import check
from acquire.calibrate.choose import corrected
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.orientation import oriented, view_named
from acquire.calibrate.psf import Edge, psf, straight_edges, widths
from acquire.calibrate.still import Still
from acquire.calibrate.words import known_facts
from acquire.errors import UsageError
from acquire.lines import Segment
from acquire.sim.media import VideoSceneConfig

STAGES, S, FINER = 64, 3, 8
SIZE = STAGES * S
RIG = {"geometry.stages": STAGES, "cameras.a.responsivity_dn": 3.0, "cameras.b.responsivity_dn": 3.0}


def edges(directory: Path, turn_deg: float, effects: Any) -> VideoSceneConfig:
    np.save(directory / "edges.npy", board(turn_deg)[None])
    table = {"kind": "video", "path": directory / "edges.npy", "system_gain_dn_per_e": 0.1}
    return VideoSceneConfig.model_validate(table | {"effects": list(effects)})


def board(turn_deg: float) -> Any:
    """Draw a turned checkerboard of 58 fine pixels per square; a pixel is the mean over its area."""
    angle = np.deg2rad(turn_deg)
    at = (np.arange(SIZE * FINER) + 0.5) / FINER - SIZE / 2
    y, x = np.meshgrid(at, at, indexing="ij")
    u, v = y * np.cos(angle) + x * np.sin(angle), x * np.cos(angle) - y * np.sin(angle)
    squares = (np.floor(u / 58 + 0.5) + np.floor(v / 58 + 0.5)) % 2
    return squares.reshape(SIZE, FINER, SIZE, FINER).mean(axis=(1, 3)).astype(np.float32)


def blurred(sigma: float, of_b: float | None = None) -> dict[str, Any]:
    return {"kind": "psf", "sigma_pixels": sigma} | ({} if of_b is None else {"sigma_b_pixels": of_b})


def taken(path: Path, turn_deg: float, *effects: Any, lines: int = 1024) -> Path:
    return record(path, edges(path.parent, turn_deg, (*NOISE, *effects)), "target", lines, **RIG)


@pytest.fixture(scope="module")
def unequal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record edges with optics whose arms differ."""
    return taken(tmp_path_factory.mktemp("unequal") / "edges.zarr", 8.0, blurred(0.7, 1.4))


@pytest.fixture(scope="module")
def known(unequal: Path) -> Calibration:
    exposure = open_exposure(unequal)
    empty = Calibration(exposure.instrument)
    return empty.with_step(psf(exposure, empty))


def test_the_width_of_each_arm_is_measured(known: Calibration) -> None:
    found = known.quantities["blur_px"]
    np.testing.assert_allclose(found.value, [[0.7, 0.7], [1.4, 1.4]], atol=0.08)
    assert (np.abs(found.value - [[0.7], [1.4]]) < 2.5 * found.uncertainty).all()
    assert known.steps["psf"]["warnings"] == []
    assert "b across the transfer 1.4" in known_facts(known)["the optics' blur"]
    assert corrected(known) == ["the optics' blur"]


def test_unequal_columns_do_not_change_the_widths(tmp_path: Path) -> None:
    """Without a dark and a flat, which is why the guided step needs neither."""
    uneven = ({"kind": "prnu", "prnu": 0.03}, {"kind": "column_offsets", "sigma_dn": 5.0})
    exposure = open_exposure(taken(tmp_path / "edges.zarr", 8.0, blurred(0.7, 1.4), *uneven))
    found = psf(exposure, Calibration(exposure.instrument)).quantities["blur_px"]
    np.testing.assert_allclose(found.value, [[0.7, 0.7], [1.4, 1.4]], atol=0.12)


def still(turn_deg: float) -> Still:
    """Return the image of a checkerboard with optics that do not blur."""
    fine = board(turn_deg)
    rows = np.pad(fine, ((S - 1, S - 1), (0, 0)))
    summed = np.lib.stride_tricks.sliding_window_view(rows, S, axis=0).sum(axis=-1)
    image = 10 * summed.reshape(len(summed), STAGES, S).sum(axis=-1)
    noise = np.random.default_rng(0).standard_normal(image.shape)
    return Still(image + noise, 1.0, 0.1, np.ones(STAGES, np.bool_))


def test_optics_without_blur_get_none(monkeypatch: pytest.MonkeyPatch, unequal: Path) -> None:
    monkeypatch.setattr(method, "stills", lambda _segment: (still(5.0), still(12.0)))
    exposure = open_exposure(unequal)
    empty = Calibration(exposure.instrument)
    found = psf(exposure, empty)
    sharp = empty.with_step(found)
    assert len(found.warnings) == 4
    assert "the blur is not clearly above 0; it is at most 0." in found.warnings[0]
    assert blur_of(sharp) is None
    assert corrected(sharp) == []
    assert "not clearly above 0" in known_facts(sharp)["the optics' blur"]
    assert calibrated(exposure.whole(), sharp).blur is None


def test_edges_along_the_grid_are_ignored() -> None:
    assert straight_edges(still(0.0), S, "a") == []
    with pytest.raises(UsageError, match="blur of the optics of arm a cannot be measured: only 0 windows"):
        widths([], "a")


def test_edges_hidden_by_noise_are_refused() -> None:
    image = np.random.default_rng(0).standard_normal((194, 64))
    hidden = Still(image, 1.0, 0.1, np.ones(64, np.bool_))
    with pytest.raises(
        UsageError, match=r"arm b cannot be measured: its best edge is 2\.\d times the image's noise, and 10"
    ):
        straight_edges(hidden, 3, "b")


def test_dots_are_not_edges(tmp_path: Path) -> None:
    exposure = open_exposure(record(tmp_path / "dots.zarr", dots(tmp_path, NOISE), "target"))
    with pytest.raises(UsageError, match="blur of the optics of arm a cannot be measured"):
        psf(exposure, Calibration(exposure.instrument))


def test_steady_light_shows_no_edges(tmp_path: Path) -> None:
    scene = edges(tmp_path, 8.0, NOISE)
    exposure = open_exposure(record(tmp_path / "flat.zarr", scene, "flat", 64, **RIG))
    with pytest.raises(UsageError, match="constant code"):
        psf(exposure, Calibration(exposure.instrument))


def test_edges_in_one_direction_determine_one_axis_only() -> None:
    with pytest.raises(UsageError, match="do not show the blur across the transfer; slanted edges along it"):
        widths([Edge((np.cos(0.1 + t), np.sin(0.1 + t)), 0.5, 0.02) for t in np.linspace(0, 0.1, 20)], "b")


def with_blur(known: Calibration, value: Any, sure: float = 0.02) -> Calibration:
    widths = np.asarray(value, np.float64)
    return replace(known, quantities={"blur_px": Measured(widths, np.full_like(widths, sure))})


@pytest.fixture(scope="module")
def lines(unequal: Path) -> Segment:
    return open_exposure(unequal, None, 64).whole()


def test_only_widths_clearly_above_0_are_in_the_model(known: Calibration, lines: Segment) -> None:
    assert calibrated(lines, with_blur(known, [[0.5, 0.03], [0.0, 0.7]])).blur == Blur((0.5, 0), (0, 0.7))
    assert calibrated(lines, with_blur(known, [[0.5, 0.5], [0.5, 0.5]], sure=0.3)).blur is None


def test_widths_stay_with_their_camera(known: Calibration, lines: Segment) -> None:
    measured = calibrated(lines, with_blur(known, [[0.5, 0.6], [0.7, 0.8]]))
    assert oriented(measured, view_named("turn 270")).blur == Blur((0.7, 0.8), (0.5, 0.6))
    assert oriented(measured, view_named("turn 270, mirrored")).blur == measured.blur


def test_blur_by_registration_is_not_counted_twice(known: Calibration, lines: Segment) -> None:
    """The interpolation's share, 1/4 of a pixel² along columns, is subtracted from the measured width."""
    found = AlignmentFound(Alignment(0.0, 0.5), {})
    laid = calibrated(lines, replace(with_blur(known, [[0.5, 0.6], [0.7, 0.8]]), alignment=found))
    assert laid.blur is not None
    assert laid.blur.a == (0.5, 0.6)
    assert laid.blur.b == pytest.approx((np.sqrt(0.7**2 - 0.25), 0.8), abs=1e-9)
    sharper = calibrated(lines, replace(with_blur(known, [[0.5, 0.6], [0.3, 0.8]]), alignment=found))
    assert sharper.blur is not None
    assert sharper.blur.b == pytest.approx((0, 0.8), abs=1e-9)


def test_a_check_compares_the_focus(unequal: Path, known: Calibration) -> None:
    """A checkerboard does not show the orientation, but its edges show whether the focus has changed."""
    exposure = open_exposure(unequal)
    assert [each.holds for each in check(exposure, known).compared] == [True] * 4
    moved = check(exposure, with_blur(known, [[0.7, 0.7], [0.9, 1.4]]))
    assert [each.holds for each in moved.compared] == [True, True, False, True]
    assert not moved.holds
    assert moved.compared[2].quantity == "blur of arm b along the transfer"


def test_a_check_reports_a_target_that_does_not_show_the_focus(tmp_path: Path) -> None:
    exposure = open_exposure(record(tmp_path / "dots.zarr", dots(tmp_path, NOISE), "target"))
    held = with_blur(Calibration(exposure.instrument), [[0.7, 0.7], [0.9, 1.4]])
    found = check(exposure, held)
    assert not any("blur" in each.quantity for each in found.compared)
    assert any(
        "the optics' blur was not compared: the blur of the optics of arm" in doubt for doubt in found.doubts
    )


def test_an_image_without_light_or_noise_is_refused() -> None:
    dark = Still(np.zeros((SIZE + S - 1, STAGES)), 0.0, 0.0, np.ones(STAGES, np.bool_))
    with pytest.raises(UsageError, match="best edge"):
        straight_edges(dark, S, "a")
