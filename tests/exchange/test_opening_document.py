"""OPENING.md: its commands are run, in their order, and its examples opened."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest

from acquire.cli import main

TEXT = (Path(__file__).parents[2] / "acquire" / "exchange" / "OPENING.md").read_text(encoding="utf-8")
COMMANDS = [
    line
    for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
    for line in block.splitlines()
    if line.startswith("acquire ")
]


def test_its_commands_run(
    recording: Path, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(recording, tmp_path / "run.zarr")
    shutil.copytree(video, tmp_path / "video.zarr")
    monkeypatch.chdir(tmp_path)
    assert len(COMMANDS) >= 8
    for command in COMMANDS:
        monkeypatch.setattr(sys, "argv", shlex.split(command, comments=True))
        assert main() == 0, command
