"""Tiles of a scene behind a fibre: each is solved like a separate scene, and one video shows them all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.config import RigConfig, load_rig
from acquire.config.scene import ConstantDrive, SineDrive
from acquire.errors import UsageError
from acquire.fibre import Tile
from acquire.noise import Noise
from acquire.recon import reconstruct
from acquire.recon.reuse import Choice
from acquire.recon.segments import Voxels
from acquire.reconstruct import Monitor, Options, Outcome, by_lines, combine, in_tiles, in_voxels, open_pool
from acquire.reconstruct.liveliest import energies
from acquire.sim.leds import LedConfig, LedSceneConfig
from acquire.sim.scenes import build_scene
from acquire.simulate import simulate
from acquire.store import Recording, open_recording, open_video

SETTINGS = {"geometry.stages": 24, "geometry.substeps": 1, "cameras.layout": "fibre"}
SETTINGS |= {"fibre.rows": 48, "fibre.columns": 72, "fibre.sensor_pixels": 150}
LINES = 130
OPTIONS = Options(iterations=20, check=False)


@pytest.fixture(scope="module")
def rig() -> RigConfig:
    return load_rig("rig-demo", SETTINGS)


@pytest.fixture(scope="module")
def scene() -> LedSceneConfig:
    """Shapes that cross the borders of tiles; one flickers."""
    steady, sine = (
        ConstantDrive(waveform="constant", level=0.7),
        SineDrive(waveform="sine", frequency_hz=900.0, low=0.2),
    )
    leds = (
        LedConfig(name="disc", shape="circle", row=0.5, column=0.35, size=0.5, drive=steady),
        LedConfig(name="x", shape="x", row=0.45, column=0.8, size=0.35, drive=sine),
    )
    return LedSceneConfig(kind="leds", title="across tiles", leds=leds)


@pytest.fixture(scope="module")
def recording(rig: RigConfig, scene: LedSceneConfig, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("fibre") / "run.zarr"
    simulate(rig, scene, path, LINES)
    return open_recording(path)


def combined(
    recording: Recording, out: Path, voxels: Voxels, tiles: tuple[Tile, ...], monitor: Monitor | None = None
) -> Outcome:
    request = in_tiles(in_voxels(by_lines(recording), voxels, longest=60), tiles)
    monitor = monitor or Monitor(len(request.stretches) * len(tiles))
    with open_pool(1, watch=monitor) as pool:
        return combine(recording, request, out, options=OPTIONS, pool=pool, monitor=monitor)


def truth(rig: RigConfig, scene: LedSceneConfig, substeps: np.ndarray) -> np.ndarray:
    fibre = rig.laid_out
    rows, columns = fibre.field()
    shown = build_scene(scene, fibre.side, rig.trigger.substep_ticks / rig.trigger.clock_hz)
    return shown.frames_at(substeps)[:, rows, columns]


def test_a_video_of_all_tiles_shows_the_whole_scene(
    rig: RigConfig, scene: LedSceneConfig, recording: Recording, tmp_path: Path
) -> None:
    outcome = combined(recording, tmp_path / "v.zarr", Voxels(2, 4), recording.fibre.tiles)
    video = open_video(tmp_path / "v.zarr")
    assert outcome.shape == video.video.shape == (26, 24, 36)
    first = outcome.provenance["first_substep"]
    fine = truth(rig, scene, np.arange(first, first + 4 * 26))
    expected = fine.reshape(26, 4, 24, 2, 36, 2).mean(axis=(1, 3, 5))
    found = np.asarray(video.video[:])
    kept = video.trusted
    assert len(kept) == 26
    assert 10 * np.log10(1 / np.mean((found[kept] - expected[kept]) ** 2)) > 25
    assert np.isfinite(video.quality).all()
    assert video.error.shape == (26, 2 * 8, 3 * 8)
    assert np.isfinite(video.error[:]).all()
    assert video.time_ns[1] - video.time_ns[0] == round(4 * recording.line_period_ns)
    assert len(outcome.provenance["segments"]) == outcome.provenance["segments_asked"] == 6 * 2
    solved = [part["tile"] for part in outcome.provenance["segments"][::2]]
    assert sorted(solved) == list(map(str, recording.fibre.tiles))
    choice = outcome.provenance["choice"]
    assert choice["searched"] == ["0,2"]  # where the x flickers
    assert {*choice["kept"], *choice["changed"]} >= {*solved} - {"0,2"}


def test_each_tile_searches_separately_if_requested(recording: Recording, tmp_path: Path) -> None:
    request = in_tiles(in_voxels(by_lines(recording), Voxels(6, 153)), recording.fibre.tiles[:2])
    monitor = Monitor(2)
    with open_pool(1, watch=monitor) as pool:
        options = replace(OPTIONS, shared=False)
        outcome = combine(
            recording, request, tmp_path / "v.zarr", options=options, pool=pool, monitor=monitor
        )
    assert outcome.provenance["choice"] is None
    assert [part["kept_choice"] for part in outcome.provenance["segments"]] == [None, None]


def test_lines_distinguish_changing_tiles_from_tiles_at_rest(recording: Recording) -> None:
    change = {str(tile): energies(recording.cut(0, LINES, tile))[1] for tile in recording.fibre.tiles}
    assert max(change, key=lambda tile: change[tile]) == "0,2"
    assert max(change["0,0"], change["1,0"]) < 0.1 * change["0,2"]


@pytest.mark.parametrize("arm", [0, 1])
def test_an_arm_with_too_few_complete_lines_does_not_hide_the_change_that_the_other_shows(
    recording: Recording, arm: int
) -> None:
    """Both arms' noise was subtracted from the residual of one: a tile with a gap seemed to be at rest."""
    segment = recording.cut(0, LINES, Tile(0, 2))
    alone, few = segment.mask.copy(), segment.mask.copy()
    alone[arm] = False
    line, pixel = np.ogrid[20:LINES, : segment.geometry.stages]
    few[arm, 20:] &= (line + pixel) % 3 > 0  # 20 lines are complete: too few for a fit
    without_noise = energies(replace(segment, mask=alone, noise=None))[1]
    dark_dn = float(np.sqrt(0.6 * without_noise) * np.mean(segment.responsivity_dn))
    noisy = replace(segment, noise=Noise((0.0, 0.0), (dark_dn, dark_dn)))
    change = energies(replace(noisy, mask=alone))[1]
    assert change == pytest.approx(0.4 * without_noise, rel=0.05)
    assert energies(replace(noisy, mask=few))[1] == pytest.approx(change)


def test_a_choice_that_does_not_fit_is_searched_again(recording: Recording) -> None:
    segment = recording.cut(0, LINES, Tile(0, 2))
    still = Choice("still", 1, 2e-3, 0.0, error=0.001, noise=float("nan"))
    handed = reconstruct(segment, 2, 4, iterations=20, check=False, choice=still)
    alone = reconstruct(segment, 2, 4, iterations=20, check=False)
    assert not still.kept(handed.parameters)
    assert Choice.of(alone).kept(handed.parameters)
    np.testing.assert_array_equal(handed.video, alone.video)
    again = reconstruct(segment, 2, 4, iterations=20, check=False, choice=Choice.of(alone))
    assert len(again.parameters["candidates"]) < len(alone.parameters["candidates"])
    assert again.quality.prediction <= 1.05 * alone.quality.prediction


def test_a_part_equals_the_whole_there_and_states_its_position(recording: Recording, tmp_path: Path) -> None:
    tiles = (Tile(1, 1), Tile(1, 2))
    combined(recording, tmp_path / "part.zarr", Voxels(3, 153), tiles)
    part = open_video(tmp_path / "part.zarr")
    assert part.video.shape == (1, 8, 16)
    assert part.origin[1:] == (24 + 1, 24 + 1)
    for number, tile in enumerate(tiles):
        segment = recording.cut(0, LINES, tile)
        alone = reconstruct(segment, 3, 153, iterations=20, check=False)
        image = np.asarray(part.video[0])[:, 8 * number : 8 * number + 8]
        assert np.corrcoef(image.ravel(), alone.video[0].ravel())[0, 1] > 0.9


def test_an_interrupted_video_has_holes_and_trusts_nothing(recording: Recording, tmp_path: Path) -> None:
    begun: list[float] = []
    monitor = Monitor(12, stop=lambda: bool(begun) and begun[-1] > 4.5)
    monitor._progress = lambda done, _: begun.append(done)
    outcome = combined(recording, tmp_path / "v.zarr", Voxels(2, 4), recording.fibre.tiles, monitor)
    assert outcome.interrupted
    video = open_video(tmp_path / "v.zarr")
    image = np.asarray(video.video[:])
    assert image.shape == (26, 24, 36)
    there = np.isfinite(image).all(axis=0).reshape(2, 12, 3, 12).all(axis=(1, 3))
    assert there[0].sum() == 2  # the one where most changes, which all others wait for, and the first
    assert there[0, 2]
    assert not there[1].any()
    assert not video.trusted
    assert outcome.provenance["state"] == "interrupted"


def test_voxels_that_cross_the_borders_of_tiles_are_refused(recording: Recording) -> None:
    request = in_voxels(by_lines(recording), Voxels(5, 4))
    with pytest.raises(
        UsageError, match=r"N_m = 5 do not fill the tiles .* possible: N_m of 1, 2, 3, 4, 6, 8"
    ):
        in_tiles(request, recording.fibre.tiles)
    assert in_tiles(request, ()) == request
