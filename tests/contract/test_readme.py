"""The README's commands are the ones that are run, and what it names exists."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from acquire.config import load_rig, load_scene
from acquire.simulate import simulate

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = [
    example
    for example in re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    if "acquire.client" not in example  # tests/service/test_client.py
]
BLOCKS = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)


def test_ci_runs_the_second_command_as_it_stands() -> None:
    assert BLOCKS[1].strip() in (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()


def test_the_first_command_ends_in_the_demo() -> None:
    assert BLOCKS[0].strip().endswith(".venv/bin/acquire demo")


def test_every_command_it_shows_exists() -> None:
    shown = set(
        re.findall(r"acquire ([a-z]+)", "".join(re.findall(r"`[^`]+`|```sh.*?```", README, re.DOTALL)))
    )
    helped = subprocess.run(
        [sys.executable, "-m", "acquire", "--help"], capture_output=True, text=True, timeout=300, check=True
    ).stdout
    assert {"demo", "serve", "arm", "start", "status"} <= shown
    assert [command for command in sorted(shown) if not re.search(rf"\b{command}\b", helped)] == []


def test_every_path_it_names_exists() -> None:
    named = re.findall(r"`((?:acquire|configs|tests|tools)/[\w./-]*)`", README)
    assert len(named) > 10
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_its_python_examples_run_on_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = load_rig("rig-demo", {"geometry.stages": 16})
    simulate(rig, load_scene("scene-leds"), tmp_path / "run.zarr", 2000)
    monkeypatch.chdir(tmp_path)
    assert len(EXAMPLES) == 2
    names: dict[str, object] = {}
    for example in EXAMPLES:
        exec(example.replace("lines=263", "lines=60"), names)
    assert names["video"].shape == (3 * 60 - 3 * 16 + 1, 16, 16)
