"""Help and status come at once; the table of commands is what the modules register."""

from __future__ import annotations

import re
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from acquire.cli.commands import BY_NAME, COMMANDS, MODULES
from acquire.cli.usage import build
from acquire.config import load_rig, load_scene
from acquire.simulate import simulate

Cli = Callable[..., Any]
LATE = {"rich", "pydantic", "numpy", "zarr", "acquire.config", "acquire.store"}
"""What the help of no command needs."""
PROCESSOR_S = 2.0
"""Ten times what is expected, for a slow machine: what is loaded is asked exactly."""


def test_the_table_is_what_the_modules_register() -> None:
    for module in MODULES:
        commands = typer.main.get_command(build([module])).commands  # type: ignore[attr-defined]
        assert set(commands) == {command.name for command in COMMANDS if command.module == module}
        for name, command in commands.items():
            assert command.rich_help_panel == BY_NAME[name].panel


@pytest.mark.parametrize("words", [[], ["start"], ["trigger"], ["calibrate", "dark"]], ids=" ".join)
def test_help_loads_nothing_that_it_does_not_need(words: list[str]) -> None:
    code = (
        "import sys\nfrom acquire.cli import main\n"
        f"sys.argv = ['acquire', *{words!r}, '--help']\n"
        f"assert main() == 0\nprint('loaded:', sorted({LATE!r} & set(sys.modules)))"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    ended = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=300
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert ended.stdout.splitlines()[-1] == "loaded: []"
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < PROCESSOR_S


@pytest.mark.parametrize("columns", [60, 80, 120, 200])
def test_the_overview_fits_the_terminal(cli: Cli, monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    said = cli("--help").out
    assert max(map(len, said.splitlines())) <= columns
    for command in COMMANDS:
        assert re.search(rf"^  {command.name} ", said, re.MULTILINE)


def test_no_words_are_answered_with_the_overview_and_exit_2(cli: Cli) -> None:
    answer = cli()
    assert (answer.code, answer.out) == (2, "")
    assert "Begin here:" in answer.err


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("stauts",), "no such command 'stauts'; did you mean 'status'?"),
        (("--versoin",), "no such option: --versoin; did you mean '--version'?"),
        (("start", "--line", "5"), "start: no such option: --line; did you mean '--lines'?"),
        (("calibrate", "drak"), "calibrate: no such command 'drak'; did you mean 'dark'?"),
        (("config", "check", "rig-dmeo"), "'rig-dmeo' does not exist; did you mean 'rig-demo'?"),
        (("status", "--wait", "armd"), "no state 'armd'; did you mean 'armed'?"),
    ],
)
def test_what_was_probably_meant_is_named(cli: Cli, words: tuple[str, ...], meant: str) -> None:
    answer = cli(*words)
    assert answer.code == 2
    assert meant in answer.err


def test_what_is_like_nothing_is_told_without_a_guess(cli: Cli) -> None:
    assert "did you mean" not in cli("xyzzy").err


def test_help_names_the_environment_s_variables(cli: Cli) -> None:
    assert "[env var: ACQUIRE_SOCKET]" in cli("arm", "--help").out


@pytest.mark.parametrize("words", [["ls", "."], ["info", "run.zarr"]], ids=" ".join)
def test_recordings_are_listed_without_zarr_python(tmp_path: Path, words: list[str]) -> None:
    """The metadata is read by our own reader: the library takes half a second to import."""
    simulate(
        load_rig("rig-demo", {"geometry.stages": 8}), load_scene("scene-leds"), tmp_path / "run.zarr", 100
    )
    code = (
        "import sys\nfrom acquire.cli import main\n"
        f"sys.argv = ['acquire', *{words!r}]\n"
        f"assert main() == 0\nprint('loaded:', sorted({{'zarr', 'rich', 'scipy'}} & set(sys.modules)))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True, timeout=300
    )
    assert "run.zarr" in ended.stdout
    assert ended.stdout.splitlines()[-1] == "loaded: []"
