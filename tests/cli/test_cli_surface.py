"""Properties that all commands share: help with an example, errors in words, exit codes, quick start."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from acquire import __version__
from acquire.cli import app, control
from acquire.cli.output import print_table
from acquire.errors import EXIT_INTERRUPTED

Cli = Callable[..., Any]
HEAVY = {"numpy", "zarr", "numba", "scipy", "matplotlib", "httpx", "fastapi", "uvicorn"}


def walk(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    if not hasattr(command, "commands"):
        yield words
        return
    for name, below in command.commands.items():
        yield from walk(below, (*words, name))


COMMANDS = list(walk(typer.main.get_command(app)))


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_has_an_example(cli: Cli, words: tuple[str, ...]) -> None:
    answer = cli(*words, "--help")
    assert answer.code == 0
    assert f"Example: acquire {' '.join(words)}" in answer.out


def test_the_contract_s_commands_are_there() -> None:
    names = {words[0] for words in COMMANDS}
    assert {"serve", "arm", "start", "stop", "disarm", "status", "ls", "info", "cut", "config"} <= names


def test_version(cli: Cli) -> None:
    assert cli("--version").out.strip() == __version__


@pytest.mark.parametrize(
    "words", [("stauts",), ("start", "--line", "5"), ("cut",), ("start", "--lines", "x")]
)
def test_wrong_arguments_exit_with_2(cli: Cli, words: list[str]) -> None:
    assert cli(*words).code == 2


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_fits_a_narrow_terminal_and_cuts_no_name(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    said = cli(*words, "--help").out
    assert max(map(len, said.splitlines())) <= 60
    assert not re.search(r"-…|-\.\.\.|\[/?(bold)?\]", said)
    example = said[said.index("Example:") :].split()
    assert example[: len(words) + 2] == ["Example:", "acquire", *words]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_names_values_in_words_and_no_types(cli: Cli, words: tuple[str, ...]) -> None:
    said = cli(*words, "--help").out
    assert not re.search(r"<(int|float|str|path|file|dir|list|bool|uuid|datetime)\b|[<>]=", said.lower())
    assert not re.search(r"^  (-., )?--[\w-]+ <", said, re.MULTILINE)


@pytest.mark.parametrize(
    ("words", "command", "message"),
    [
        (("stauts",), "acquire", "there is no command 'stauts'"),
        (("start", "--line", "5"), "acquire start", "start: there is no option --line"),
        (("cut",), "acquire cut", "cut: the argument 'RECORDING' is missing"),
        (("start", "--lines", "x"), "acquire start", "start: invalid value for '--lines'"),
        (("demo", "--trigger", "x"), "acquire demo", "demo: invalid value for '--trigger': 'x' is not one"),
        (("trigger", "lod"), "acquire trigger", "trigger: there is no command 'lod'"),
    ],
)
def test_wrong_arguments_are_reported_like_all_errors(
    cli: Cli, words: tuple[str, ...], command: str, message: str
) -> None:
    answer = cli(*words)
    assert (answer.code, answer.out) == (2, "")
    assert answer.err.startswith(f"acquire: error: {message}")
    assert answer.err.endswith(f"  try: {command} --help\n")
    error = json.loads(cli(*words, "--json").err)["error"]
    assert error["message"].startswith(message)
    assert (error["kind"], error["exit_code"], error["hint"]) == ("UsageError", 2, f"{command} --help")


def test_an_option_without_its_value_is_reported_with_its_command(cli: Cli) -> None:
    told = cli("start", "take.zarr", "--post").err.splitlines()
    assert told == [
        "acquire: error: start: option '--post' requires an argument",
        "  try: acquire start --help",
    ]


def test_text_wider_than_the_terminal_is_wrapped_between_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [("run.zarr", "1000", "in good order"), ("other.zarr", "2", "")]
    titles = ("recording", "lines", "how it ended")
    monkeypatch.setenv("COLUMNS", "40")
    print_table(titles, rows)
    assert capsys.readouterr().out.splitlines() == [
        "recording   lines  how it ended",
        "run.zarr     1000  in good order",
        "other.zarr      2",
    ]
    monkeypatch.setenv("COLUMNS", "30")
    print_table(titles, rows)
    assert capsys.readouterr().out.splitlines() == [
        "recording     run.zarr",
        "lines         1000",
        "how it ended  in good order",
        "",
        "recording  other.zarr",
        "lines      2",
    ]
    monkeypatch.delenv("COLUMNS")
    print_table(("a" * 300,), [("b",)])
    assert len(capsys.readouterr().out.splitlines()) == 2


@pytest.mark.parametrize("command", ["status", "arm", "start", "stop", "disarm"])
def test_no_daemon_in_words(cli: Cli, tmp_path: Path, command: str) -> None:
    answer = cli(command, "--socket", tmp_path / "no.sock")
    assert answer.code == 3
    assert answer.out == ""
    *_, first, hint = answer.err.splitlines()  # before them, that a daemon of another test is starting
    assert first.startswith(f"acquire: error: no daemon listens on {tmp_path / 'no.sock'}")
    assert hint.startswith("  try: acquire serve")


def test_error_as_json(cli: Cli, tmp_path: Path) -> None:
    answer = cli("status", "--json", "--socket", tmp_path / "no.sock")
    error = json.loads(answer.err)["error"]
    assert (answer.code, error["exit_code"], error["kind"]) == (3, 3, "NoDaemonError")


def test_socket_from_the_environment(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ACQUIRE_SOCKET", str(tmp_path / "env.sock"))
    assert "env.sock" in cli("arm").err


def test_unknown_state_to_wait_for(cli: Cli) -> None:
    answer = cli("status", "--wait", "done")
    assert answer.code == 2
    assert "idle, armed, recording, draining, faulted" in answer.err


def test_interrupted(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(control, "status_document", interrupted)
    assert cli("status").code == EXIT_INTERRUPTED


def test_interrupted_in_the_body_of_a_class(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python before 3.12 makes a RuntimeError of it: Ctrl-C during imports gave a traceback and code 1."""

    def interrupted(_: object) -> None:
        raise RuntimeError("Error calling __set_name__") from KeyboardInterrupt()

    monkeypatch.setattr(control, "status_document", interrupted)
    assert cli("status").code == EXIT_INTERRUPTED


@pytest.mark.parametrize("words", [["--help"], ["status", "--help"], ["serve", "--help"]])
def test_help_loads_nothing_heavy(words: list[str]) -> None:
    code = (
        "import sys\nfrom acquire.cli import app\n"
        "try:\n    app(sys.argv[1:])\n"
        f"finally:\n    print('loaded:', sorted({HEAVY!r} & set(sys.modules)))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code, *words], check=True, capture_output=True, text=True, timeout=300
    )
    assert ended.stdout.splitlines()[-1] == "loaded: []"


def test_status_loads_no_models_or_mathematics(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom acquire.cli import main\nfrom acquire.daemon import glance\n"
        "glance.is_one_starting = lambda place: False\n"  # another test's daemon may be
        "assert main() == 3\n"
        f"print(sorted({HEAVY | {'pydantic'}!r} & set(sys.modules)))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code, "status", "--socket", str(tmp_path / "no.sock")],
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ended.stdout.strip() == "[]"


def test_errors_of_the_system_are_reported_in_words(cli: Cli, tmp_path: Path) -> None:
    answer = cli("info", tmp_path / ("long" * 100))
    assert answer.code in {2, 6}
    assert "File name too long" in answer.err
    assert "Traceback" not in answer.err


def test_a_full_disk_behind_stdout_ends_in_words() -> None:
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "acquire", "config", "schema"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=300,
            check=False,
        )
    assert ended.returncode == 5
    assert ended.stderr == "acquire: error: standard output: No space left on device\n"


@pytest.mark.parametrize(
    ("words", "closed", "code"),
    [
        (("plugins",), ">&-", 0),
        (("plugins",), "<&- >&- 2>&-", 0),
        (("serve", "--config", "nowhere"), "2>&-", 2),
        (("serve", "--config", "nowhere"), "2>/dev/full", 2),
        (("calibrate", "all", "--out", "{home}/cal.zarr", "--socket", "{home}/no.sock"), "<&-", 3),
    ],
)
def test_closed_and_full_streams_change_nothing_else(
    tmp_path: Path, words: tuple[str, ...], closed: str, code: int
) -> None:
    """As under cron, or after `exec >&-`."""
    command = " ".join([sys.executable, "-m", "acquire", *words]).format(home=tmp_path)
    ended = subprocess.run(
        ["/bin/sh", "-c", f"{command} {closed}"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert ended.returncode == code, ended.stderr
    assert "Traceback" not in ended.stderr


def test_no_file_gets_the_descriptor_of_a_closed_stream(tmp_path: Path) -> None:
    code = (
        "import os, sys; sys.argv = ['acquire', '--version']; from acquire.cli import main; main();"
        "number = os.open('new', os.O_CREAT | os.O_WRONLY); os.write(2, b'a library'); sys.exit(number)"
    )
    ended = subprocess.run(
        ["/bin/sh", "-c", f'{sys.executable} -c "{code}" 2>&-'], timeout=60, check=False, cwd=tmp_path
    )
    assert ended.returncode > 2
    assert (tmp_path / "new").read_bytes() == b""


def test_progress_and_notes_that_cannot_be_written_end_no_work() -> None:
    code = "from acquire.cli.output import note; note('one'); note('two'); print('done')"
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [sys.executable, "-c", code],
            stdout=subprocess.PIPE,
            stderr=full,
            text=True,
            timeout=60,
            check=False,
        )
    assert ended.stdout == "done\n"
