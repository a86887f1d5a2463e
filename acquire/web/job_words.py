"""Jobs as `acquire` commands: their arguments, the names of their results, and their progress reports."""

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

MOST_TEXT = 300
"""Longest progress text, in characters."""


def free_name(directory: Path, request: JobRequest) -> str:
    """Return an unused name for the result, from recording, lines and voxels. Raises UsageError."""
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
    raise UsageError(f"there are already a thousand results named {stem}", hint="remove some")


def recording_words(request: JobRequest, name: str) -> list[str]:
    """Return the arguments of the command that makes ``name`` from a recording."""
    # last, and after "--": its name may begin as an option does
    recording = ["--", request.recording]
    lines = ["--first-line", str(request.first_line), "--lines", str(request.lines), "--out", name, "--json"]
    if request.kind == "cut":
        return ["cut", *lines, *recording]
    if request.kind == "preview":
        return ["reconstruct", *lines, "--preview", "--workers", "1", *recording]
    voxels = ["--spatial-merge", str(request.spatial_merge), "--temporal-merge", str(request.temporal_merge)]
    preset = ["--preset", request.preset, "--workers", "1"]
    return ["reconstruct", *lines, *voxels, *preset, *recording]


def calibration_words(request: CalibrationRequest, out: Path) -> list[str]:
    """Return the arguments of the command that carries out a step of the calibration at ``out``."""
    steps = {"delay": ["delay"], "linearity": ["linearity"]}
    words = ["calibrate", *steps.get(request.step, ["all", "--only", request.step])]
    lines = [] if request.lines is None else ["--lines", str(request.lines)]
    black = ["--black"] if request.black else []
    return [*words, *black, "--yes", "--out", str(out), "--directory", RECORDINGS, *lines, "--json"]


def progress_facts(line: str) -> dict[str, Any]:
    """Return the job's facts that a line on a command's standard error changes: text, done and total."""
    try:
        facts = json.loads(line)
    except ValueError:
        return {"text": shortened(line.strip().removeprefix("acquire: "), MOST_TEXT)}
    if not isinstance(facts, dict):
        return {"text": shortened(line.strip(), MOST_TEXT)}
    if isinstance(error := facts.get("error"), dict):
        parts = [str(error.get("message", ""))]
        for key, word in (("possible", "possible"), ("hint", "try")):
            if error.get(key):
                parts.append(f"{word}: {error[key]}")
        return {"text": shortened("; ".join(parts), MOST_TEXT)}
    if isinstance(progress := facts.get("progress"), dict):
        left_s = progress.get("left_s")
        remaining = "" if left_s is None else f", about {left_s:.0f} s left"
        return {
            "text": shortened(f"{progress.get('what', 'working')}{remaining}", MOST_TEXT),
            "done": progress.get("done"),
            "total": progress.get("total"),
        }
    return {"text": shortened(", ".join(map(str, facts.values())), MOST_TEXT)}
