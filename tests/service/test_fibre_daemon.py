"""A daemon behind a fibre: its cameras deliver what `simulate` writes, and every command copes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from live_daemon import END_S, Daemon, acquire

from acquire.config import load_rig, load_scene
from acquire.fibre import Tile
from acquire.simulate import simulate
from acquire.store import open_recording
from acquire.store.suspect import suspect_lines

FIBRE = {"fibre.rows": 32, "fibre.columns": 48, "fibre.sensor_pixels": 53}
SETTINGS = {"cameras.layout": "fibre", **FIBRE}


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    found = Daemon(
        tmp_path_factory.mktemp("fibre"),
        "cameras.layout='fibre'",
        *(f"{key}={value}" for key, value in FIBRE.items()),
    )
    try:
        yield found
    finally:
        found.close()


@pytest.fixture(scope="module")
def recorded(daemon: Daemon) -> Path:
    path = daemon.home / "first.zarr"
    with daemon.client() as client:
        client.arm(force=True)
        client.start(path, lines=12_000)
        client.wait({"idle", "armed"}, 120)
    return path


def test_the_daemon_records_the_lines_that_simulate_writes(
    daemon: Daemon, recorded: Path, tmp_path: Path
) -> None:
    first = open_recording(recorded)
    rig = load_rig(daemon.config, SETTINGS)
    simulate(rig, load_scene(rig.scene_file()), tmp_path / "s.zarr", first.first_line + 600)
    simulated = open_recording(tmp_path / "s.zarr")
    assert first.attrs["layout"] == simulated.attrs["layout"] == "fibre"
    assert first.attrs["geometry"] == simulated.attrs["geometry"]
    for arm in "ab":
        rows = simulated.camera(arm).read("lines", first.first_line, first.first_line + 600)
        assert rows.shape == (600, 53)
        np.testing.assert_array_equal(first.camera(arm).read("lines", 0, 600), rows)
        lit = rows.any(axis=0)
        assert lit.any()
        assert not lit[[0, 1, 51, 52]].any()


def test_the_light_s_code_is_verified_through_the_fibre(daemon: Daemon, recorded: Path) -> None:
    # Asked of the daemon, which goes on checking: whether a verdict falls into a short take is chance.
    end_s = time.monotonic() + END_S
    with daemon.client() as client:
        while True:
            checks = [arm.check for arm in client.status().arms.values()]
            if all(check is not None and check.verdict != "unknown" for check in checks):
                break
            assert time.monotonic() < end_s, checks
            time.sleep(0.05)
    assert [check.verdict for check in checks if check is not None] == ["verified", "verified"]
    assert not suspect_lines(open_recording(recorded))


def test_commands_cope_with_lines_that_are_wider_than_the_sensor_has_stages(
    recorded: Path, tmp_path: Path
) -> None:
    output = " ".join(acquire("info", recorded).out.split())  # lines are as long as the terminal is wide
    assert (
        "32 x 48 fine pixels behind a fibre, 2 x 3 tiles of 16 x 16; 2 and 3 fibre bands on arms a and b"
        in output
    )
    assert acquire("verify", recorded).code == 0
    assert open_recording(recorded).overview("a").rows.shape[1] == 53
    answer = acquire("cut", recorded, "--tile", "1,2", "--lines", 40, "--out", tmp_path / "t.npz")
    assert answer.code == 0, answer.err
    with np.load(tmp_path / "t.npz") as kept:
        found = open_recording(recorded)
        a, b = found.fibre.pixels(Tile(1, 2))
        assert kept["lines"].shape == (2, 40, 8)
        np.testing.assert_array_equal(kept["lines"][0], found.camera("a").read("lines", 0, 40)[:, a])
        np.testing.assert_array_equal(kept["lines"][1], found.camera("b").read("lines", 0, 40)[:, b])
        assert kept["first_column"].tolist() == [a.start, b.start]
    for words, reason in (
        ((), "shows 6 tiles of a scene behind a fibre; none was named"),
        (("--tile", "2,0"), "no tile 2,0; possible: ROW,COLUMN from 0,0 to 1,2".replace("; ", "\n  ")),
        (("--tile", "0-1,0"), "takes one tile, but 0-1,0 selects 2"),
        (("--tile", "x"), "tiles 'x' cannot be read"),
    ):
        answer = acquire("cut", recorded, *words, "--lines", 40, "--out", tmp_path / "no.npz")
        assert (answer.code, reason in answer.err) == (2, True), answer.err


def test_a_recording_behind_a_fibre_is_replayed_identically(recorded: Path, tmp_path: Path) -> None:
    answer = acquire("replay", recorded, "--out", tmp_path / "again.zarr", "--speed", 10, "--json")
    assert answer.code == 0, answer.err + answer.out
    assert answer.json["identical"] is True
    again = open_recording(tmp_path / "again.zarr")
    assert again.fibre == open_recording(recorded).fibre
    assert again.attrs["layout"] == "fibre"
