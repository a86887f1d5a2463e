"""OPENING.md: its commands are run in order, and its examples executed."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import xarray

from acquire.cli import main

TEXT = (Path(__file__).parents[2] / "acquire" / "exchange" / "OPENING.md").read_text(encoding="utf-8")
COMMANDS = [
    line
    for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
    for line in block.splitlines()
    if line.startswith("acquire ")
]

EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def test_its_examples_run(
    recording: Path, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "acquire" in xarray.backends.list_engines(), "install the package as it stands: pip install -e ."
    shutil.copytree(recording, tmp_path / "run.zarr")
    shutil.copytree(video, tmp_path / "video.zarr")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for example in EXAMPLES:
        exec(example, names)
    assert names["some"].sizes == {"line": 11, "pixel": 6}
    assert set(names["video"]["0"].coords) == {"t", "y", "x", "time", "trusted"}
    assert names["arm"]["line"].values[[0, -1]].tolist() == [100, 189]
    assert names["whole"].shape == (2, 6)
    names["video"].close()
    names["arm"].close()


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
