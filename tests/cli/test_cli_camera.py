"""``acquire devices`` and ``acquire camera`` on simulated rigs."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from acquire.config import load_rig
from acquire.geometry import Geometry
from acquire.rig import Rig
from acquire.sim.lines import StreamingArm

Cli = Callable[..., Any]
GENTL = pytest.param("rig-demo-gentl", marks=pytest.mark.needs_compiler)
RIGS = ["rig-demo", GENTL]


@pytest.mark.parametrize("rig", RIGS)
def test_devices_of_a_rig_are_listed_with_their_serial_numbers(cli: Cli, rig: str) -> None:
    rows = cli("devices", "--config", rig, "--json").json
    assert [(row["device"], row["serial"], row["state"]) for row in rows] == [
        ("trigger", "0" * 16, "ready"),
        ("camera a", "SIM-A", "ready"),
        ("camera b", "SIM-B", "ready"),
    ]


def test_missing_parts_of_a_rig_are_reported(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    answer = cli("devices", "--config", "rig-vt-4k5c-h100")
    assert answer.code == 0
    assert answer.out.count("there is no GenTL producer; possible: .cti files") == 2


def of_host(producers: str) -> list[dict[str, str]]:
    """``acquire devices`` as a process: libusb, Aravis and producers keep what they opened until its end."""
    command = [sys.executable, "-m", "acquire", "devices", "--json"]
    environment = os.environ | {"GENICAM_GENTL64_PATH": producers}
    done = subprocess.run(command, env=environment, capture_output=True, timeout=300, check=True)
    return json.loads(done.stdout)


def test_without_a_rig_every_transport_lists_its_devices() -> None:
    rows = {row["device"]: row["state"] for row in of_host("")}
    assert list(rows) == ["trigger, serial", "trigger, USB", "camera, GenTL", "camera, Aravis"]
    assert "try: set cti in the camera's table, or GENICAM_GENTL64_PATH" in rows["camera, GenTL"]


@pytest.mark.needs_genicam
def test_cameras_of_the_environment_s_producers_are_listed() -> None:
    import genicam

    rows = of_host(str(Path(genicam.__file__).parent))
    assert {row["model"] for row in rows if row["device"] == "camera, GenTL"} == {"Viky"}


@pytest.mark.needs_compiler
def test_features_show_their_value_and_possible_values(cli: Cli) -> None:
    rows = cli("camera", "features", "SIM-A", "--config", "rig-demo-gentl", "--json").json
    by_name = {(row["module"], row["feature"]): row for row in rows}
    assert by_name["remote", "PixelFormat"]["value"] == "Mono12p"
    assert by_name["remote", "TDIStages"]["possible"] == "TDI64, TDI128, TDI192, TDI256"
    assert by_name["stream", "BufferHeight"]["value"] == 256
    assert by_name["remote", "SensorWidth"]["access"] == "r"
    assert {module for module, _ in by_name} == {"remote", "interface", "device", "stream", "system"}


@pytest.mark.parametrize("rig", RIGS)
def test_a_snapshot_is_what_the_camera_sees(cli: Cli, tmp_path: Path, rig: str) -> None:
    out = tmp_path / "b.npy"
    facts = cli("camera", "snapshot", "SIM-B", "--config", rig, "--lines", 300, "--out", out, "--json").json
    pixels = np.load(out)
    config = load_rig(rig)
    depth = Geometry(64, 3, 1).depth_lines
    with Rig(config) as made:
        light = StreamingArm(made.scene(), config.code.build(), 64, 3, "b").lines(-depth, 300)
    np.testing.assert_allclose(pixels, 6.0 * light.astype(np.float64), rtol=0, atol=0.5 + 1e-3)  # rounding
    assert (facts["lines"], facts["pixels"], facts["flagged_lines"]) == (300, 64, 0)


@pytest.mark.parametrize("suffix", [".npy", ".png"])
def test_a_snapshot_that_the_disk_refuses_leaves_nothing(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    out = tmp_path / f"a{suffix}"
    answer = cli("camera", "snapshot", "SIM-A", "-c", "rig-demo", "--lines", 200, "--out", out)
    assert (answer.code, list(tmp_path.iterdir())) == (5, [])
    assert "No space left" in answer.err


def test_a_picture_is_stretched(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "a.png"
    assert cli("camera", "snapshot", "SIM-A", "-c", "rig-demo", "--lines", 200, "--out", out).code == 0
    with Image.open(out) as picture:
        assert (picture.size, picture.getextrema()) == ((64, 200), (0, 255))


def test_wrong_arguments_change_nothing(cli: Cli, tmp_path: Path) -> None:
    taken = tmp_path / "a.png"
    taken.touch()
    for words, text in (
        (
            ("SIM-C", "-c", "rig-demo", "--out", tmp_path / "x.png"),
            "no camera 'SIM-C'\n  possible: SIM-A, SIM-B",
        ),
        (("SIM-A", "-c", "rig-demo", "--out", taken), "exists and is not overwritten"),
        (("SIM-A", "-c", "rig-demo", "--out", tmp_path / "x.jpg"), "possible: .png, .npy"),
        (("SIM-A", "-c", "rig-demo", "--out", ""), "the path is empty"),
    ):
        answer = cli("camera", "snapshot", *words)
        assert (answer.code, text in answer.err) == (2, True), answer.err
