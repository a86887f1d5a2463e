"""``acquire demo`` as a user runs it, and its recording checked by code that shares nothing with ours."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import xarray
import zarr
from waiting import until

LINES = 4000
SEED = 4711


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("demo") / "run"
    command = ["demo", f"--out={out}", f"--seed={SEED}", f"--lines={LINES}", "--twist-budget=2", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "acquire", *command],
        cwd=out.parent,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return out, json.loads(done.stdout)


def galois_bits(code: dict[str, Any], count: int) -> np.ndarray:
    """The recorded code, one register step per bit."""
    mask = sum(1 << (tap - 1) for tap in code["taps"])
    state, bits = int(code["state"], 16), np.empty(count, np.int64)
    for k in range(count):
        bits[k] = state & 1
        state = (state >> 1) ^ (mask if bits[k] else 0)
    return bits


def eq1(X: np.ndarray, E: np.ndarray, M: int, S: int, L_R: int) -> np.ndarray:
    """Eq. (1): rows and columns of whole pixels are summed by hand."""
    merged = X.reshape(*X.shape[:2], M, S).sum(axis=3) * E[:, None, None]
    Y = np.zeros((L_R, M))
    for i in range(L_R):
        for r in range(M * S):
            first = r + i * S
            Y[i] += merged[first : first + S, r].sum(axis=0)
    return Y


def test_recorded_lines_are_eq1_of_the_truth_and_the_recorded_code(demo: tuple[Path, dict[str, Any]]) -> None:
    out, summary = demo
    recording = zarr.open_group(out / "recording.zarr", mode="r")
    attrs: dict[str, Any] = dict(recording.attrs)
    truth = zarr.open_group(out / "truth.zarr", mode="r")
    X = np.asarray(truth["0"][:], np.float64)
    M, S = attrs["geometry"]["stages"], attrs["geometry"]["substeps"]
    first, L_R = summary["segment"]["first_line"], summary["segment"]["lines"]
    T = S * (M + L_R) - 1
    assert X.shape == (T, M * S, M * S)
    row = first - attrs["first_line"]
    index = int(recording["a/code_index"][row])
    E = galois_bits(attrs["code"], index + T)[index:]
    for arm, scene in (("a", X), ("b", np.rot90(X, 1, axes=(1, 2)))):
        camera = attrs["cameras"][arm]
        expected = camera["black_level_dn"] + camera["responsivity_dn"] * eq1(scene, E, M, S, L_R)
        recorded = np.asarray(recording[f"{arm}/lines"][row : row + L_R], np.float64)
        assert expected.max() < camera["white_dn"]
        assert np.abs(recorded - expected).max() < 0.51  # rounded to whole DN


def test_every_line_has_number_code_and_time_and_none_is_lost(demo: tuple[Path, dict[str, Any]]) -> None:
    out, summary = demo
    attrs: dict[str, Any] = dict(zarr.open_group(out / "recording.zarr", mode="r").attrs)
    bits = galois_bits(attrs["code"], 3 * (attrs["first_line"] + LINES))
    for arm in ("a", "b"):
        lines = xarray.open_zarr(out / "recording.zarr", group=arm)
        assert lines.sizes["line"] == LINES
        assert not lines["flags"].any()
        number = attrs["first_line"] + np.arange(LINES)
        np.testing.assert_array_equal(lines["code_index"], 3 * number)
        np.testing.assert_array_equal(
            lines["code"], bits[3 * number] + 2 * bits[3 * number + 1] + 4 * bits[3 * number + 2]
        )
        np.testing.assert_array_equal(np.diff(lines["tick"].astype(np.int64)), 2700)
        np.testing.assert_array_equal(np.diff(lines["time"].astype(np.int64)), 30_000)
        assert summary["capture"]["arms"][arm]["missing"] == 0
    assert summary["capture"]["condition"] == "GOOD"
    assert summary["capture"]["lost_lines"] == 0


def test_the_reconstruction_is_good_and_compared_with_the_papers_solver(
    demo: tuple[Path, dict[str, Any]],
) -> None:
    _, summary = demo
    default, paper = summary["solvers"]
    assert default["psnr_db"] >= 27
    assert paper["label"].startswith("TwIST")
    assert paper["psnr_db"] < default["psnr_db"]
    set_hz = {"x": 5000, "triangle": 2500, "circle": 1000}
    for curve in default["curves"]:
        if curve["name"] in set_hz:
            assert abs(curve["measured_hz"] - set_hz[curve["name"]]) < 5


def test_all_files_are_in_the_requested_directory(demo: tuple[Path, dict[str, Any]]) -> None:
    out, summary = demo
    names = {path.name for path in out.iterdir()}
    assert {"index.html", "summary.json", "lines.png", "frames.png", "curves.png", "animation.webp"} <= names
    assert {"recording.zarr", "truth.zarr", "video.zarr", "video-twist.zarr"} <= names
    assert [path.name for path in out.parent.iterdir()] == ["run"]
    assert "<html" in Path(summary["report"]).read_text(encoding="utf-8")
    running = [p for p in psutil.process_iter(["cmdline"]) if str(out) in " ".join(p.info["cmdline"] or [])]
    assert not running


@pytest.mark.parametrize("at", ["daemon.log", ".recordings-demo.lock", "recording.zarr"])
def test_ctrl_c_leaves_a_directory_only_if_something_was_recorded(tmp_path: Path, at: str) -> None:
    """As in a terminal, whose Ctrl-C also reaches the daemon."""
    out = tmp_path / "run"
    demo = subprocess.Popen(
        [sys.executable, "-m", "acquire", "demo", f"--out={out}"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until((out / at).exists)
    os.killpg(demo.pid, signal.SIGINT)
    said = demo.communicate(timeout=60)[1]
    assert demo.returncode == 130, said
    assert "Traceback" not in said
    assert (out / "recording.zarr").exists() == out.exists() == (at == "recording.zarr")


def test_a_directory_that_exists_is_refused_and_untouched(demo: tuple[Path, dict[str, Any]]) -> None:
    out, _ = demo
    before = sorted((path, path.stat().st_mtime_ns) for path in out.rglob("*"))
    again = subprocess.run(
        [sys.executable, "-m", "acquire", "demo", f"--out={out}"],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert again.returncode == 2
    assert "exists and is not overwritten" in again.stderr
    assert sorted((path, path.stat().st_mtime_ns) for path in out.rglob("*")) == before
