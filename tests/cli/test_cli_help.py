"""Help and status appear at once; the table of commands is what the modules register."""

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

from acquire.cli.coercion import range_in_words
from acquire.cli.commands import BY_NAME, COMMANDS, MODULES
from acquire.cli.usage import build
from acquire.config import load_rig, load_scene
from acquire.simulate import simulate

Cli = Callable[..., Any]
LATE = {"rich", "pydantic", "numpy", "zarr", "acquire.config", "acquire.store"}
"""What the help of no command needs."""
LIBRARIES = {"multiprocessing", "numcodecs", "numpy", "pydantic", "rich", "scipy", "zarr"}
"""What a list of recordings does without."""
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


def test_without_arguments_the_overview_is_shown_with_exit_code_2(cli: Cli) -> None:
    answer = cli()
    assert (answer.code, answer.out) == (2, "")
    assert "Begin here:" in answer.err


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("stauts",), "there is no command 'stauts'; did you mean 'status'?"),
        (("--versoin",), "there is no option --versoin; did you mean '--version'?"),
        (("start", "--line", "5"), "start: there is no option --line; did you mean '--lines'?"),
        (("calibrate", "drak"), "calibrate: there is no command 'drak'; did you mean 'dark'?"),
        (("config", "check", "rig-dmeo"), "'rig-dmeo' does not exist; did you mean 'rig-demo'?"),
        (("status", "--wait", "armd"), "no state 'armd'; did you mean 'armed'?"),
    ],
)
def test_a_typo_gets_a_suggestion(cli: Cli, words: tuple[str, ...], meant: str) -> None:
    answer = cli(*words)
    assert answer.code == 2
    assert meant in answer.err


def test_an_unrecognisable_word_gets_no_suggestion(cli: Cli) -> None:
    assert "did you mean" not in cli("xyzzy").err


def test_help_names_what_an_option_takes_and_its_range(cli: Cli) -> None:
    said = cli("demo", "--help").out
    assert "--trigger simulated|rtl" in said
    assert re.search(r"--seed N +Seed of the exposure code.  \[default: 1; 0 or\s+more\]", said)


def test_help_names_the_environment_s_variables(cli: Cli) -> None:
    assert "[env var: ACQUIRE_SOCKET]" in cli("arm", "--help").out


@pytest.mark.parametrize(
    "words", [["ls", "."], ["info", "run.zarr"], ["info", "run.zarr", "--json"]], ids=" ".join
)
@pytest.mark.parametrize("state", ["sealed", "growing", "among odd entries"])
def test_recordings_are_listed_without_array_libraries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], state: str
) -> None:
    """Metadata and small tables need the standard library alone; the others take longer than the answer."""
    monkeypatch.setenv("COLUMNS", "200")
    path, rig = tmp_path / "run.zarr", load_rig("rig-demo", {"geometry.stages": 8})
    simulate(rig, load_scene("scene-leds"), path, 100)
    root = path / "zarr.json"
    if state == "growing":
        root.write_text(root.read_text().replace('"state":"sealed"', '"state":"recording"'))
    if state == "among odd entries":
        (tmp_path / "empty.zarr").mkdir()
        (tmp_path / "link.zarr").symlink_to(path)
        (tmp_path / "nothing.zarr").symlink_to(tmp_path / "gone")
        (tmp_path / "file.zarr").write_text("no directory")
        (tmp_path / "torn.zarr").mkdir()
        (tmp_path / "torn.zarr" / "zarr.json").write_bytes(root.read_bytes()[:500])
    code = (
        "import sys\nfrom acquire.cli import main\n"
        f"sys.argv = ['acquire', *{words!r}]\n"
        f"assert main() == 0\nprint('loaded:', sorted({LIBRARIES!r} & set(sys.modules)))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True, timeout=300
    )
    assert "run.zarr" in ended.stdout
    if state == "among odd entries" and words[0] == "ls":
        listed = {line.split()[0]: line for line in ended.stdout.splitlines()[1:-1]}
        assert set(listed) == {"empty.zarr", "link.zarr", "nothing.zarr", "run.zarr", "torn.zarr"}
        assert "link" in listed["nothing.zarr"]
        assert "is not a recording: it holds no zarr.json" in listed["empty.zarr"]
        assert "zarr.json is damaged" in listed["torn.zarr"]
    assert ended.stdout.splitlines()[-1] == "loaded: []"


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ((1, 9), "1 to 9"),
        ((64, 2**20), "64 to 1048576"),
        ((0.001, 1e9), "0.001 to 1000000000"),
        ((1, None), "1 or more"),
        ((None, 9), "9 or less"),
        ((None, None), ""),
    ],
)
def test_limits_are_written_in_full(limits: tuple[float | None, float | None], words: str) -> None:
    assert range_in_words(*limits) == words
