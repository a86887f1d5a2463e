"""Offsets, gains, noise and electrons of columns, compared with those that the simulator drew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from instruments import ALL, COLUMNS, NOISE, columns_truth, dots, record, white

from acquire.calibrate import Calibration
from acquire.calibrate.columns import ambient, dark, dark_edges, flat
from acquire.calibrate.exposure import BLOCK_LINES, Exposure, moments, open_exposure
from acquire.calibrate.transfer import transfer
from acquire.errors import UsageError

ARMS = ("a", "b")


def measured(*exposures: Exposure) -> Calibration:
    """A dark, and a flat if there is one."""
    first = dark(exposures[0])
    calibration = Calibration(first.instrument).with_step(first)
    return calibration.with_step(flat(exposures[1], calibration)) if len(exposures) > 1 else calibration


def test_uncertainties_of_offsets_and_noise_are_true(recordings: dict[str, Path], known: Calibration) -> None:
    truth = columns_truth(white(effects=[{"kind": "column_offsets", "sigma_dn": 2.0, "channels": 6}]), "dark")
    offset, noise = known.quantities["offset_dn"], known.quantities["noise_dn"]
    error = offset.value - np.stack([truth[arm] for arm in ARMS])
    assert np.abs(error).max() < 0.5 + 5 * offset.uncertainty.max()  # the truth is rounded to whole DN
    sigma = np.hypot(25.0 * 0.1, np.sqrt(1 / 12))
    assert np.abs(noise.value - sigma).max() < 5 * noise.uncertainty.max()
    assert noise.value.mean() == pytest.approx(sigma, rel=0.01)
    assert known.usable is not None
    assert known.usable.all()


def test_gains_to_a_part_in_a_thousand(tmp_path: Path) -> None:
    effects = [*NOISE, *COLUMNS, {"kind": "beam_splitter", "part_a": 0.46}]
    paths = [
        record(tmp_path / f"{each}.zarr", white(effects=effects), each, 1024) for each in ("dark", "flat")
    ]
    calibration = measured(*map(open_exposure, paths))
    gain, truth = calibration.quantities["gain"], columns_truth(white(effects=[COLUMNS[0]]))
    for i, arm in enumerate(ARMS):
        own = (truth[arm] - 20.0) / np.mean(truth[arm] - 20.0)
        error = gain.value[i] - own
        assert np.abs(error).max() < 1e-3
        assert np.sqrt(np.mean(error**2)) < 1.5 * np.median(gain.uncertainty)


def test_columns_darkened_by_the_optics_keep_their_gain(
    recordings: dict[str, Path], known: Calibration
) -> None:
    """Arm B is displaced by 1.5 and −1 fine pixels: its edge columns get less light but keep the gain 1."""
    hidden = known.steps["flat"]["optics_hide_columns"]
    assert 0 in hidden["b"] or 23 in hidden["b"]
    assert hidden["a"] == []
    gain = known.value("gain")
    assert gain is not None
    assert all(gain[1, column] == 1 for column in hidden["b"])


@pytest.mark.parametrize(("sigma", "hidden"), [(0.5, True), (None, False)])
def test_a_blurred_edge_of_the_field_is_not_a_gain(tmp_path: Path, sigma: float | None, hidden: bool) -> None:
    """The outermost columns lack some percent each, no more than columns differ, but together it is clear."""
    blur = [] if sigma is None else [{"kind": "psf", "sigma_pixels": sigma}]
    scene = white(effects=[*NOISE, *COLUMNS, *blur])
    paths = [record(tmp_path / f"{each}.zarr", scene, each) for each in ("dark", "flat")]
    step = measured(*map(open_exposure, paths)).steps["flat"]
    edge = {0, 23}
    assert all(edge.issubset(step["optics_hide_columns"][arm]) is hidden for arm in ARMS)


def test_a_bright_column_does_not_hide_the_edge_of_its_arm() -> None:
    """The column at the other end is dark, and the optics darken both."""
    own = 1 + 0.018 * np.random.default_rng(3).standard_normal((2, 64))
    own[:, [0, -1]] = [[1.055, 0.966], [1.0, 1.0]]
    seen = own.copy()
    seen[0, [0, -1]] *= 0.93
    usable = np.ones(seen.shape, bool)
    found, without = (dark_edges(each, usable) for each in (seen, own))
    assert found[0, [0, -1]].all()
    assert not without[:, 1:-1].any()
    assert not without[0, 0]
    assert not found[1].any()


@pytest.mark.parametrize("part_a", [0.46, 0.5, 0.57])
def test_the_splitter(tmp_path: Path, part_a: float) -> None:
    effects = [*NOISE, *COLUMNS, {"kind": "beam_splitter", "part_a": part_a}]
    paths = [record(tmp_path / f"{each}.zarr", white(0.4, effects), each, 64) for each in ("dark", "flat")]
    calibration = measured(*map(open_exposure, paths))
    own = columns_truth(white(0.4, COLUMNS))
    expected = (
        part_a
        * np.mean(own["a"] - 20)
        / (part_a * np.mean(own["a"] - 20) + (1 - part_a) * np.mean(own["b"] - 20))
    )
    assert calibration.steps["flat"]["part_a"] == pytest.approx(expected, abs=2e-3)


def test_a_smooth_lamp_is_not_attributed_to_columns(tmp_path: Path) -> None:
    """With --smooth the polynomial part is attributed to the scene, and the columns' own part stays."""
    effects = [*NOISE, {"kind": "prnu", "prnu": 0.02}]
    paths = [record(tmp_path / f"{each}.zarr", white(0.4, effects), each) for each in ("dark", "flat")]
    exposures = [open_exposure(path) for path in paths]
    plain = measured(*exposures)
    smooth = plain.with_step(flat(exposures[1], plain, smooth=True))
    gains = [each.value("gain") for each in (plain, smooth)]
    assert gains[0] is not None
    assert gains[1] is not None
    x = np.linspace(-1, 1, gains[0].shape[1])
    for row, smoothed in zip(*gains, strict=True):
        fit = np.polynomial.Chebyshev.fit(x, row, 4)(x)
        np.testing.assert_allclose(smoothed, row / fit * np.mean(fit / 1), rtol=2e-3)


def test_electrons_from_the_noise(recordings: dict[str, Path], known: Calibration) -> None:
    found = transfer([open_exposure(recordings["flat"])], known)
    K, read = found.quantities["dn_per_electron"], found.quantities["read_noise_e"]
    assert np.abs(K.value - 0.1).max() < 4 * K.uncertainty.max()
    assert K.uncertainty.max() < 2e-3
    assert np.abs(read.value - 25.0).max() < 4 * read.uncertainty.max()
    assert "full_well_e" not in found.quantities


def test_flickering_light_is_not_mistaken_for_shot_noise(tmp_path: Path) -> None:
    """Jitter of 1 % of a sub-step changes all columns alike, ten times as much as shot noise does."""
    effects = [*NOISE, *COLUMNS, {"kind": "trigger_jitter", "sigma_s": 2e-6}]
    paths = [record(tmp_path / f"{each}.zarr", white(effects=effects), each) for each in ("dark", "flat")]
    exposures = [open_exposure(path) for path in paths]
    K = transfer([exposures[1]], measured(exposures[0])).quantities["dn_per_electron"]
    assert np.abs(K.value - 0.1).max() < 4 * K.uncertainty.max()


def test_the_full_well_shows_where_the_noise_ends(tmp_path: Path) -> None:
    effects = [*NOISE, {"kind": "full_well", "capacity_e": 20_000}]
    levels = [record(tmp_path / f"{x}.zarr", white(x, effects), "flat") for x in (0.1, 0.2, 0.3, 0.37, 0.42)]
    zero = record(tmp_path / "dark.zarr", white(effects=effects), "dark")
    found = transfer([open_exposure(path) for path in levels], measured(open_exposure(zero)))
    assert found.quantities["full_well_e"].value == pytest.approx([20_000, 20_000], rel=0.1)
    assert found.quantities["dn_per_electron"].value == pytest.approx([0.1, 0.1], rel=0.03)


def test_ambient_light_is_separated_from_the_offset(tmp_path: Path) -> None:
    bright = [*NOISE, *COLUMNS, {"kind": "stray_light", "ambient": 0.02}]
    paths = {
        "covered": record(tmp_path / "covered.zarr", white(effects=[*NOISE, *COLUMNS]), "dark"),
        "open": record(tmp_path / "open.zarr", white(effects=bright), "dark"),
    }
    first = dark(open_exposure(paths["covered"]), covered=True)
    calibration = Calibration(first.instrument).with_step(first)
    found = ambient(open_exposure(paths["open"]), calibration)
    expected = 0.02 * 24 * 27 * 8.0
    assert found.quantities["ambient_dn"].value.mean() == pytest.approx(expected, rel=0.01)
    whole = dark(open_exposure(paths["open"]))
    with pytest.raises(UsageError, match="ambient light already"):
        ambient(open_exposure(paths["open"]), Calibration(whole.instrument).with_step(whole))


def test_dark_lines_that_reach_zero_are_refused(tmp_path: Path) -> None:
    clipped = record(
        tmp_path / "dark.zarr", white(effects=NOISE), "dark", **{"cameras.a.black_level_dn": 2.0}
    )
    with pytest.raises(UsageError, match="reach 0 DN") as told:
        dark(open_exposure(clipped))
    assert "BlackLevel" in told.value.hint


def test_lit_lines_are_not_dark(recordings: dict[str, Path], tmp_path: Path) -> None:
    """With --covered, a lit flat and a lit target were taken as dark, their light as offsets."""
    for light, why in (("flat", "its light was steady"), ("target", "its light blinked with a code")):
        exposure = open_exposure(recordings[light])
        with pytest.raises(UsageError, match=why) as told:
            dark(exposure)
        assert "--covered" in told.value.hint
        with pytest.raises(UsageError, match="so the lens was open"):
            dark(exposure, covered=True)
    # a lamp that is small, dim, and somewhere
    led = {"name": "x", "shape": "square", "row": 0.3, "column": 0.7, "size": 0.15}
    led["drive"] = {"waveform": "sine", "frequency_hz": 900.0, "low": 0.0, "high": 0.2}
    lamp = white(effects=NOISE).model_dump() | {"leds": [led]}
    path = record(tmp_path / "lamp.zarr", type(white()).model_validate(lamp), "target")
    with pytest.raises(UsageError, match="follow the light's code"):
        dark(open_exposure(path), covered=True)


def test_a_covered_lens_allows_any_code(tmp_path: Path) -> None:
    effects = [*NOISE, *COLUMNS, {"kind": "drift", "offset_dn_per_hour": 1e4}]
    path = record(tmp_path / "covered.zarr", white(0.0, effects), "target")
    assert dark(open_exposure(path), covered=True).facts["covered"] is True


def test_room_light_in_a_dark_is_reported(tmp_path: Path) -> None:
    effects = [*NOISE, {"kind": "stray_light", "ambient": 0.1}]
    found = dark(open_exposure(record(tmp_path / "dark.zarr", white(effects=effects), "dark")))
    assert "ambient light takes this part" in found.warnings[0]


def test_a_dark_that_is_saturated_is_refused(tmp_path: Path) -> None:
    """Offsets of 4095 DN without noise were saved, with the warning of a room that is a little bright."""
    effects = [*NOISE, {"kind": "stray_light", "ambient": 1.0}]
    path = record(tmp_path / "dark.zarr", white(effects=effects), "dark")
    with pytest.raises(UsageError, match="is not dark: 100% of its samples are saturated"):
        dark(open_exposure(path))


def test_a_flat_of_a_target_is_refused(tmp_path: Path, known: Calibration) -> None:
    """Its texture was taken for gains that differ by 25 %."""
    path = record(tmp_path / "flat.zarr", dots(tmp_path, ALL), "flat")
    with pytest.raises(UsageError, match="is not uniform") as told:
        flat(open_exposure(path), known, smooth=True)
    assert "white card" in told.value.hint


def test_an_uneven_flat_says_what_it_may_be(tmp_path: Path, known: Calibration) -> None:
    path = record(tmp_path / "flat.zarr", white(0.45, [*ALL, {"kind": "vignetting", "loss": 0.3}]), "flat")
    exposure = open_exposure(path)
    assert "falls smoothly by 1" in flat(exposure, known).warnings[0]
    assert not any("smoothly" in each for each in flat(exposure, known, smooth=True).warnings)


@pytest.mark.parametrize(
    ("light", "level", "said"),
    [
        ("flat", 1.0, "saturated"),
        ("flat", 0.001, "the light adds"),
        ("target", 0.4, "does not have the steady light"),
    ],
)
def test_unsuitable_flats_are_refused(
    tmp_path: Path, known: Calibration, light: str, level: float, said: str
) -> None:
    path = record(tmp_path / "flat.zarr", white(level, ALL), light, 64)
    with pytest.raises(UsageError, match=said):
        flat(open_exposure(path), known)


def test_a_flat_needs_a_dark(recordings: dict[str, Path], known: Calibration) -> None:
    for step in (flat, lambda each, empty: transfer([each], empty)):
        with pytest.raises(UsageError, match="offsets of the columns first"):
            step(open_exposure(recordings["flat"]), Calibration(known.instrument))


def test_few_lines_are_refused(recordings: dict[str, Path]) -> None:
    with pytest.raises(UsageError, match="too short"):
        open_exposure(recordings["dark"], lines=5)


def test_lines_without_shot_noise_are_refused(tmp_path: Path) -> None:
    effects = [{"kind": "read_noise", "sigma_e": 25.0}]
    paths = [
        record(tmp_path / f"{each}.zarr", white(effects=effects), each, 256) for each in ("dark", "flat")
    ]
    exposures = [open_exposure(path) for path in paths]
    with pytest.raises(UsageError, match="no more noise in the light"):
        transfer([exposures[1]], measured(exposures[0]))


@pytest.mark.parametrize("left", [0, 1, 2])
def test_a_block_that_lost_nearly_all_lines_is_neither_dark_nor_a_drift(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: int
) -> None:
    """A mean of 0 counted for a single line, and a block without one was 0 DN away from the others."""
    path = record(tmp_path / "dark.zarr", white(effects=NOISE), "dark", BLOCK_LINES + 64)
    exposure = open_exposure(path)
    whole = moments(open_exposure(path, lines=BLOCK_LINES))
    blocks = list(exposure.samples())
    blocks[1][1][:, left:] = False
    monkeypatch.setattr(Exposure, "samples", lambda _: iter(blocks))
    found = moments(exposure)
    assert (found.lines == BLOCK_LINES + left).all()
    assert found.mean == pytest.approx(whole.mean, abs=6 * np.sqrt(whole.variance.max()) / BLOCK_LINES)
    assert found.variance == pytest.approx(whole.variance, rel=0.05)
    assert np.median(found.drift) < 3


@pytest.mark.parametrize("stages", [1, 2])
def test_a_flat_of_columns_that_are_all_at_an_edge(tmp_path: Path, stages: int) -> None:
    """There are no others to compare them with: numpy warned of the mean of nothing."""
    changes = {"geometry.stages": stages}
    changes |= {f"cameras.{arm}.responsivity_dn": 192.0 / stages for arm in ARMS}
    scene = white(effects=[*NOISE, *COLUMNS])
    paths = [record(tmp_path / f"{each}.zarr", scene, each, **changes) for each in ("dark", "flat")]
    for smooth in (False, True):
        first = dark(open_exposure(paths[0]))
        known = Calibration(first.instrument).with_step(first)
        gain = flat(open_exposure(paths[1]), known, smooth=smooth).quantities["gain"]
        np.testing.assert_allclose(gain.value.mean(axis=1), 1)
        assert np.isfinite(gain.uncertainty).all()


def test_a_flat_of_an_arm_without_a_column_is_refused(
    recordings: dict[str, Path], known: Calibration
) -> None:
    none_of_b = np.ones((2, 24), bool)
    none_of_b[1] = False
    with pytest.raises(UsageError, match="no column of arm b is left for a gain"):
        flat(open_exposure(recordings["flat"]), replace(known, usable=none_of_b))
