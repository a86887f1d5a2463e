"""Blur and veil in the guided calibration: measured on request, and refused if they cannot be determined."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import signal
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_daemon import COMMAND, Daemon
from waiting import until

from acquire.calibrate import Calibration, Finding, Instrument, Measured, open_calibration, save_calibration
from acquire.calibrate.sheet import Sheet

M, S, FINER = 64, 3, 8
N = M * S
SETTINGS = (
    "stream.stall_s=60",  # a host busy with other tests may take seconds for the first simulated block
    f"geometry.stages={M}",
    f"geometry.substeps={S}",
    "trigger.substep_ticks=36000",  # every sub-step is blurred: what a busy host simulates in time
    *(f"cameras.{arm}.black_level_dn=20.0" for arm in "ab"),
    *(f"cameras.{arm}.responsivity_dn=3.0" for arm in "ab"),
)
EFFECTS = """
[[effects]]
kind = "psf"
sigma_pixels = 0.7
sigma_b_pixels = 1.3
[[effects]]
kind = "stray_light"
veil = 0.02
[[effects]]
kind = "prnu"
prnu = 0.01
[[effects]]
kind = "shot_noise"
[[effects]]
kind = "read_noise"
sigma_e = 20.0
"""


def checkerboard(turn_deg: float) -> np.ndarray:
    """Squares of 58 fine pixels; each pixel has the mean over its area."""
    angle = np.deg2rad(turn_deg)
    at = (np.arange(N * FINER) + 0.5) / FINER - N / 2
    y, x = np.meshgrid(at, at, indexing="ij")
    u, v = y * np.cos(angle) + x * np.sin(angle), x * np.cos(angle) - y * np.sin(angle)
    squares = (np.floor(u / 58 + 0.5) + np.floor(v / 58 + 0.5)) % 2
    return squares.reshape(N, FINER, N, FINER).mean(axis=(1, 3)).astype(np.float32)


def put(home: Path, picture: np.ndarray) -> str:
    """Put it in front of the cameras; return the setting that names it."""
    np.save(home / "fresh.npy", picture[None])
    (home / "fresh.npy").replace(home / "scene.npy")
    (home / "scene.toml").write_text(f"kind = 'video'\npath = '{home}/scene.npy'\n{EFFECTS}")
    return f"simulation.scene='{home}/scene.toml'"


def test_blur_and_veil_are_measured_last_and_earlier_results_are_kept(tmp_path: Path) -> None:
    scene = put(tmp_path, np.full((N, N), 0.6, np.float32))
    cal = tmp_path / "cal.zarr"
    with contextlib.closing(Daemon(tmp_path, *SETTINGS, scene)) as daemon:
        words = ("calibrate", "all", "--yes", "--lines", 1024, "--out", cal)
        nothing_there = daemon(*words, "--only", "dark", "--psf")
        assert nothing_there.code == 2
        assert "the blur of the optics of arm a cannot be measured" in nothing_there.err
        assert "a square or a checkerboard, slightly turned" in nothing_there.err
        assert (
            f"{cal} has dark; to continue: acquire calibrate all --only psf --out {cal}" in nothing_there.err
        )
        assert list(open_calibration(cal).steps) == ["dark"]

        put(tmp_path, checkerboard(8.0))
        found = daemon(*words, "--only", "psf", "--json")
        assert found.code == 0, found.err
        assert "psf: Put a square or a checkerboard in" in found.err
        assert list(found.json["steps"]) == ["psf"]
        known = open_calibration(cal)
        assert list(known.steps) == ["dark", "psf"]
        blur = known.quantities["blur_px"].value
        np.testing.assert_allclose(blur, [[0.7, 0.7], [1.3, 1.3]], atol=0.12)

        black = daemon(*words, "--only", "veil", "--json")
        assert black.code == 0, black.err
        assert "veil: Put a target in, at rest, a few percent of which send no light at all" in black.err
        veil = open_calibration(cal).quantities["veil"]
        assert (np.abs(veil.value - 0.02) < 4 * veil.uncertainty).all()
        assert "the lens's veil" in daemon("calibrate", "show", cal).out
        with daemon.client() as client:
            assert client.status().state == "idle"


def test_one_target_shows_everything(tmp_path: Path) -> None:
    scene = put(tmp_path, np.full((N, N), 0.6, np.float32))
    cal = tmp_path / "cal.zarr"
    with contextlib.closing(Daemon(tmp_path, *SETTINGS, scene)) as daemon:
        words = ("calibrate", "all", "--yes", "--lines", 1024, "--out", cal)
        refused = daemon(*words, "--only", "dark", "--black")
        assert refused.code == 2
        assert "--black says something of the target" in refused.err
        assert daemon(*words, "--only", "dark").code == 0
        put(tmp_path, Sheet(S).picture(N, (-5.0, 8.0), 1.5))
        found = daemon(*words, "--only", "target", "--black", "--json")
        assert found.code == 0, found.err
        assert list(found.json["steps"]) == ["orientation", "align", "psf", "veil"]
    known = open_calibration(cal)
    np.testing.assert_allclose(known.quantities["blur_px"].value, [[0.7, 0.7], [1.3, 1.3]], atol=0.15)
    veil = known.quantities["veil"]
    assert (np.abs(veil.value - 0.02) < 4 * veil.uncertainty).all()
    assert "does not show" not in str(known.steps["align"]["warnings"])


def test_repeatedly_missing_lines_are_reported_with_the_ends_of_the_recordings(tmp_path: Path) -> None:
    scene = "kind = 'usaf'\n[[effects]]\nkind = 'dropped_lines'\nrate = 0.3\n"
    (tmp_path / "scene.toml").write_text(scene)
    settings = SETTINGS[0], f"simulation.scene='{tmp_path}/scene.toml'"
    with contextlib.closing(Daemon(tmp_path, *settings)) as daemon:
        words = ("calibrate", "all", "--yes", "--lines", 1024, "--only", "dark")
        refused = daemon(*words, "--out", tmp_path / "cal.zarr")
        with daemon.client() as client:
            assert client.status().state == "idle"
    assert refused.code == 6
    assert "3 recordings lacked lines" in refused.err
    # A slow host may end a recording by a stall instead, or lose the code's state with its tags: what is
    # promised is that each ends in a sentence of its own.
    ends = re.findall(r"of 1024 per arm \(([A-Z]+): ([^)]+)\)", refused.err)
    assert len(ends) == 4, refused.err
    assert ("INCOMPLETE", "line budget reached") in ends


@pytest.mark.parametrize(
    ("settings", "asked", "why"),
    [
        (("code={kind='constant'}",), ("--psf",), "psf: the rig's code is constant"),
        (
            ("cameras.layout='fibre'", "fibre={rows=32,columns=48,sensor_pixels=100}"),
            ("--only", "psf"),
            "psf: the rig has a fibre",
        ),
        (("code={kind='constant'}",), ("--veil",), "veil: the rig's code is constant"),
    ],
)
def test_an_unsuitable_rig_is_refused_before_anything_is_recorded(
    tmp_path: Path, settings: tuple[str, ...], asked: tuple[str, ...], why: str
) -> None:
    with contextlib.closing(Daemon(tmp_path, *settings)) as daemon:
        refused = daemon("calibrate", "all", *asked, "--yes", "--out", tmp_path / "cal.zarr")
        assert refused.code == 2
        assert why in refused.err
        assert f"leave {why.partition(':')[0]} out" in refused.err
        assert not list((tmp_path / "calibration-recordings").iterdir())


@pytest.mark.parametrize(
    ("own", "armed", "why"),
    [
        ({"stages": 12}, False, "stages M is 8 instead of 12"),
        ({"cameras": {"b": {"serial": "C"}}}, False, "camera b: serial is B instead of C"),
        ({"cameras": {"a": {"OffsetX": 16}}}, True, "camera a: OffsetX is 0 instead of 16"),
    ],
)
@pytest.mark.parametrize("words", [("all", "--only", "dark"), ("delay",), ("linearity",)], ids=" ".join)
def test_another_instruments_calibration_is_refused_before_anything_is_recorded(
    tmp_path: Path, own: dict[str, Any], armed: bool, why: str, words: tuple[str, ...]
) -> None:
    """It was refused after minutes of recording and evaluating. Some settings are known only once armed."""
    facts = {"stages": 8, "substeps": 2, "substep_s": 5e-5, "layout": "dual", "cameras": {}} | own
    instrument, cal = Instrument.model_validate(facts), tmp_path / "cal.zarr"
    columns = Measured(np.zeros((2, instrument.stages)), np.ones((2, instrument.stages)))
    found = Finding("dark", instrument, {"offset_dn": columns, "noise_dn": columns})
    save_calibration(cal, Calibration(instrument).with_step(found))
    with contextlib.closing(Daemon(tmp_path)) as daemon:
        refused = daemon("calibrate", *words, "--yes", "--out", cal)
        assert refused.code == 2
        assert f"rig small is of another instrument than {cal}: {why}" in refused.err
        assert "--out with another name" in refused.err
        assert not list(tmp_path.glob("calibration-recordings/*"))
        with daemon.client() as client:
            assert bool(client.setup().devices) == armed
            assert client.status().state == "idle"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_step_that_is_ended_leaves_the_light_s_code_on(tmp_path: Path, number: signal.Signals) -> None:
    """A closed terminal left the instrument armed with the light off: the next recording was dark."""
    with contextlib.closing(Daemon(tmp_path)) as daemon, daemon.client() as client:
        words = ("calibrate", "all", "--yes", "--only", "dark", "--lines", 1_000_000, "--out", "cal.zarr")
        parent, child = pty.openpty()
        with subprocess.Popen(
            [*COMMAND, *map(str, words)],
            stdin=child,
            stdout=child,
            stderr=child,
            cwd=tmp_path,
            env=os.environ | {"ACQUIRE_SOCKET": str(daemon.socket)},
            # nohup may have run these tests
            preexec_fn=partial(signal.signal, signal.SIGHUP, signal.SIG_DFL),  # noqa: PLW1509 - one system call
        ) as step:
            os.close(child)
            until(lambda: client.status().state == "recording")
            if number is signal.SIGHUP:
                os.close(parent)  # from now on every word to the terminal is an error
            step.send_signal(number)
            assert step.wait(120) == 130
        if number is not signal.SIGHUP:
            os.close(parent)
        assert client.status().state == "idle"
