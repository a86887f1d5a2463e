"""A scene behind a fibre from the command line: simulated, reconstructed, in whole and in part."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.store import open_recording, open_video

Cli = Callable[..., Any]

RIG = """
name = "small-fibre"
[geometry]
stages = 16
substeps = 1
[cameras]
layout = "fibre"
[cameras.a]
serial = "A"
responsivity_dn = 200.0
[cameras.b]
serial = "B"
responsivity_dn = 200.0
[fibre]
rows = 32
columns = 48
sensor_pixels = 96
bands_a = [48, 0]
bands_b = [64, 0, 32]
[simulation]
scene = "scene.toml"
"""
SCENE = """
kind = "leds"
rig = "rig.toml"
lines = 110
[[leds]]
name = "disc"
shape = "circle"
row = 0.5
column = 0.4
size = 0.5
drive = { waveform = "constant", level = 0.8 }
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("fibre")
    (home / "rig.toml").write_text(RIG)
    (home / "scene.toml").write_text(SCENE)
    words = ("simulate", home / "scene.toml", "--config", home / "rig.toml", "--out", home / "run.zarr")
    subprocess.run([Path(sys.executable).with_name("acquire"), *words], check=True, timeout=300)
    return home / "run.zarr"


def test_the_whole_scene_becomes_one_video_whatever_the_order_of_the_bands(
    cli: Cli, recording: Path, tmp_path: Path
) -> None:
    words = ("--nm", 2, "--tm", 5, "--iterations", 12, "--workers", 1)
    answer = cli("reconstruct", recording, "--out", tmp_path / "v.zarr", *words)
    assert answer.code == 0, answer.err
    assert "0,0 to 1,2, 6 of 6" in answer.out
    video = np.asarray(open_video(tmp_path / "v.zarr").video[:])
    assert video.shape[1:] == (16, 24)
    row, column = np.mgrid[:16, :24]
    disc = np.hypot(row + 0.5 - 8, column + 0.5 - 0.4 * 24)
    image = video.mean(axis=0)
    assert image[disc < 4].min() > 0.6
    assert image[disc > 8].max() < 0.2
    answer = cli("render", tmp_path / "v.zarr", "--out", tmp_path / "v.png", "--frames", 2)
    assert answer.code == 0, answer.err


def test_some_of_the_tiles_and_a_preview(cli: Cli, recording: Path, tmp_path: Path) -> None:
    words = ("--tiles", "0-1,1", "--nm", 4, "--tm", 10, "--iterations", 5, "--workers", 1, "--json")
    answer = cli("reconstruct", recording, "--out", tmp_path / "part.zarr", *words)
    assert answer.code == 0, answer.err
    assert answer.json["shape"][1:] == [8, 4]
    assert answer.json["tiles"] == ["0,1", "1,1"]
    answer = cli("reconstruct", recording, "--out", tmp_path / "look.zarr", "--preview", "--json")
    assert answer.code == 0, answer.err
    assert answer.json["shape"][1:] == [32, 48]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--tiles", "2,0"), "the fibre has no tile 2,0"),
        (("--tiles", "1-0,0"), "backwards"),
        (("--tiles", "all"), "tiles 'all' cannot be read"),
        (
            ("--nm", 3),
            "voxels of N_m = 3 do not fill the tiles behind the fibre, which are 16 fine pixels wide",
        ),
        (("--try-orientations",), "--try-orientations cannot be used behind a fibre"),
        (("--search", "none"), "there is no --search none possible: each, shared"),
    ],
)
def test_impossible_requests_are_refused_before_anything_is_created(
    cli: Cli, recording: Path, tmp_path: Path, words: tuple[object, ...], reason: str
) -> None:
    answer = cli("reconstruct", recording, "--out", tmp_path / "v.zarr", *words)
    assert (answer.code, reason in " ".join(answer.err.split())) == (2, True), answer.err
    assert not (tmp_path / "v.zarr").exists()


def test_one_tile_is_diagnosed_and_used_for_the_plan(cli: Cli, recording: Path, tmp_path: Path) -> None:
    answer = cli("diagnose", recording, "--json")
    assert answer.code == 0, answer.err
    assert answer.json["standing"] == "right"
    assert answer.json["tile"] in {"0,0", "0,1", "1,0", "1,1"}  # the others are dark
    answer = cli("diagnose", recording, "--tile", "1,0")
    assert "1,0" in answer.out
    answer = cli("diagnose", recording, "--tile", "0-1,0")
    assert (answer.code, "--tile takes one tile" in answer.err) == (2, True)
    answer = cli("reconstruct", recording, "--auto", "--save-plan", tmp_path / "plan.toml")
    assert answer.code == 0, answer.err
    assert 'why = "tile ' in (tmp_path / "plan.toml").read_text()


def test_tradeoff_compares_a_tile_with_its_truth(cli: Cli, recording: Path, tmp_path: Path) -> None:
    words = ("--preset", "fast", "--solver", "admm", "--repeats", 1, "--lines", 60, "--voxels", "2x75")
    words += ("--no-learn", "--json", "--tile", "0,1")
    answer = cli("tradeoff", recording, "--out", tmp_path / "page", *words)
    assert answer.code == 0, answer.err
    assert {row["case"] for row in answer.json["rows"]} == {"run, tile 0,1"}
    assert answer.json["rows"][-1]["psnr_db"] > 20


def test_lines_of_another_program_behind_a_fibre(cli: Cli, recording: Path, tmp_path: Path) -> None:
    opened = open_recording(recording)
    for arm in ("a", "b"):
        np.save(tmp_path / f"{arm}.npy", opened.camera(arm).lines[:])
    files, words = (tmp_path / "a.npy", tmp_path / "b.npy"), ("--config", recording.parent / "rig.toml")
    answer = cli("import", *files, "--out", tmp_path / "in.zarr", *words)
    assert answer.code == 0, answer.err
    found = open_recording(tmp_path / "in.zarr")
    assert found.fibre == opened.fibre
    tile = found.fibre.tiles[1]
    np.testing.assert_array_equal(found.cut(0, 60, tile).lines, opened.cut(0, 60, tile).lines)
    np.testing.assert_array_equal(found.cut(0, 60, tile).code, opened.cut(0, 60, tile).code)
    answer = cli("import", *files, "--out", tmp_path / "in2.zarr", *words, "--columns-a", "0:64")
    assert (answer.code, "with sensors of 96" in " ".join(answer.err.split())) == (2, True)
