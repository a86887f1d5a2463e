"""The README's commands are the ones that are run, and what it names exists."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
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
        [sys.executable, "-m", "acquire", "--help"], capture_output=True, text=True, timeout=30, check=True
    ).stdout
    assert {"demo", "serve", "arm", "start", "status"} <= shown
    assert [command for command in sorted(shown) if not re.search(rf"\b{command}\b", helped)] == []


def test_every_path_it_names_exists() -> None:
    named = re.findall(r"`((?:acquire|configs|tests|tools)/[\w./-]*)`", README)
    assert len(named) > 10
    assert [path for path in named if not (ROOT / path).exists()] == []
