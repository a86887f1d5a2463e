"""``acquire diagnose`` as a user types it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from two_squares import record_two_squares

from acquire.config.scene import ArmOptics
from acquire.lines import ARMS
from acquire.sim.effects.light import CodeErrors
from acquire.store import open_video

Cli = Callable[..., Any]


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose light is two sub-steps late."""
    late = CodeErrors(kind="code_errors", late_substeps=2)
    return record_two_squares(tmp_path_factory.mktemp("late") / "run.zarr", 150, [late])


def test_a_wrong_description_is_reported_with_its_evidence(cli: Cli, late: Path) -> None:
    answer = cli("diagnose", late)
    assert answer.code == 1, answer.err
    assert "named: the lines are 2 sub-steps late against the code" in answer.out
    assert "log likelihood" in answer.out


def test_the_same_for_programs(cli: Cli, late: Path) -> None:
    answer = cli("diagnose", late, "--lines", 100, "--json")
    assert answer.code == 1
    assert answer.json["standing"] == "named"
    assert answer.json["lines"] == 100
    best = answer.json["hypotheses"][0]
    assert "2 sub-steps late" in best["name"]
    assert best["log_likelihood"] > 0


def test_missing_lines(cli: Cli, late: Path) -> None:
    answer = cli("diagnose", late, "--first-line", 100_000_000)
    assert answer.code == 2
    assert "has no line 100000000" in answer.err


@pytest.mark.parametrize(
    ("level", "kind"), [(0, "dark"), (20, "stuck"), (2**16 - 1, "no_samples")], ids=["dark", "stuck", "white"]
)
def test_lines_that_say_nothing_are_named_as_such_in_both_arms(
    cli: Cli, late: Path, tmp_path: Path, level: int, kind: str
) -> None:
    """Dark lines were another run's code, and of two arms with the same defect one was named."""
    path = tmp_path / "run.zarr"
    shutil.copytree(late, path)
    with zarr.config.set({"array.write_empty_chunks": True}):
        for arm in ARMS:
            lines = zarr.open_array(path / arm / "lines", mode="r+")
            lines[:] = np.full(lines.shape, min(level, np.iinfo(lines.dtype).max), lines.dtype)
    answer = cli("diagnose", path)
    assert answer.code == 1, answer.err
    assert "cannot tell: the lines cannot be compared with their code" in answer.out
    also = next(line for line in answer.out.splitlines() if line.startswith(f"also ({kind})"))
    assert "arm a " in also
    assert "arm b " in also


@pytest.fixture(scope="module")
def mirrored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose arm B is mirrored; the scene is a pulsing square and a steady one."""
    b = ArmOptics(turn_deg=270, mirror=True)
    return record_two_squares(tmp_path_factory.mktemp("mirrored") / "run.zarr", 150, b=b)


def test_reconstruct_reports_a_mirrored_arm_and_corrects_it_on_request(
    cli: Cli, mirrored: Path, tmp_path: Path
) -> None:
    words = ("--nm", 2, "--iterations", 12, "--workers", 1)
    wrong = cli("reconstruct", mirrored, "--out", tmp_path / "wrong.zarr", *words)
    assert wrong.code == 0, wrong.err
    assert "warning: arm B is mirrored" in wrong.err
    assert "no frame of it is trusted" in wrong.err
    right = cli("reconstruct", mirrored, "--out", tmp_path / "right.zarr", "--try-orientations", *words)
    assert right.code == 0, right.err
    assert "the reconstruction corrects this" in right.err
    assert "warning: arm B" not in right.err
    video = open_video(tmp_path / "right.zarr").video[:]
    steady, dark = video[:, 18, 14].mean(), video[:, 18, 4].mean()
    assert steady > 10 * abs(dark)


def test_orientations_that_are_right_are_left_alone(cli: Cli, late: Path, tmp_path: Path) -> None:
    words = ("--nm", 2, "--iterations", 5, "--workers", 1, "--try-orientations")
    answer = cli("reconstruct", late, "--out", tmp_path / "v.zarr", *words)
    assert answer.code == 0, answer.err
    assert "the orientation is left as it is: the lines are 2 sub-steps late" in answer.err
