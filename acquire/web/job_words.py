"""What a job is as a command of ours: its words, the name of what it makes, and how it says how far it is."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

from acquire.errors import UsageError
from acquire.text import shortened
from acquire.web.calibrations import RECORDINGS

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.web.messages import CalibrationRequest, JobRequest

MOST_SAID = 300


def free_name(directory: Path, request: JobRequest) -> str:
    """Of what is made: after recording, lines and voxels. Raises UsageError."""
    stem = f"{request.recording.removesuffix('.zarr')}-{request.first_line}-{request.lines}"
    if request.kind == "cut":
        suffix = ".npz"
    else:
        voxels = f"{request.spatial_merge}x{request.temporal_merge}"
        stem += "-preview" if request.kind == "preview" else f"-{voxels}"
        suffix = ".zarr"
    for number in range(1, 1000):
        name = f"{stem}{f'-{number}' if number > 1 else ''}{suffix}"
        if not os.path.lexists(directory / name):
            return name
    raise UsageError(f"there are a thousand of {stem} already", hint="remove some")


def recording_words(request: JobRequest, name: str) -> list[str]:
    """The command that makes ``name`` of a recording."""
    lines = ["--first-line", str(request.first_line), "--lines", str(request.lines), "--out", name, "--json"]
    if request.kind == "cut":
        return ["cut", request.recording, *lines]
    if request.kind == "preview":
        return ["reconstruct", request.recording, *lines, "--preview", "--workers", "1"]
    voxels = ["--spatial-merge", str(request.spatial_merge), "--temporal-merge", str(request.temporal_merge)]
    how = [*voxels, "--preset", request.preset, "--workers", "1"]
    return ["reconstruct", request.recording, *lines, *how]


def calibration_words(request: CalibrationRequest, out: Path) -> list[str]:
    """The command that carries out a step of the calibration at ``out``, as somebody at the host gives it."""
    steps = {"delay": ["delay"], "linearity": ["linearity"]}
    words = ["calibrate", *steps.get(request.step, ["all", "--only", request.step])]
    lines = [] if request.lines is None else ["--lines", str(request.lines)]
    return [*words, "--yes", "--out", str(out), "--directory", RECORDINGS, *lines, "--json"]


def told(line: str) -> dict[str, Any]:
    """What a line on a command's standard error changes of a job's facts: words, and how far it is."""
    try:
        facts = json.loads(line)
    except ValueError:
        return {"text": shortened(line.strip().removeprefix("acquire: "), MOST_SAID)}
    if not isinstance(facts, dict):
        return {"text": shortened(line.strip(), MOST_SAID)}
    if isinstance(error := facts.get("error"), dict):
        words = [error.get("message", ""), *_after("possible", error), *_after("hint", error, "try")]
        return {"text": shortened("; ".join(map(str, words)), MOST_SAID)}
    if isinstance(progress := facts.get("progress"), dict):
        left = progress.get("left_s")
        ahead = "" if left is None else f", about {left:.0f} s left"
        return {
            "text": shortened(f"{progress.get('what', 'working')}{ahead}", MOST_SAID),
            "done": progress.get("done"),
            "total": progress.get("total"),
        }
    return {"text": shortened(", ".join(map(str, facts.values())), MOST_SAID)}


def _after(key: str, error: dict[str, Any], word: str = "") -> list[str]:
    return [f"{word or key}: {error[key]}"] if error.get(key) else []
