"""Completions offered to bash, zsh and fish, requested as their scripts do, and in bash itself."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquire.cli.completion import STATES
from acquire.cli.words import VARIABLE
from acquire.daemon.states import State

Cli = Callable[..., Any]
SHELLS = ("bash", "zsh", "fish")


@pytest.fixture
def offered(cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., list[str]]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "take.zarr").mkdir()
    (tmp_path / "old").mkdir()
    (tmp_path / "$(touch bad).zarr").mkdir()
    (tmp_path / "own.toml").touch()

    def ask(typed: str, shell: str = "bash") -> list[str]:
        words = typed.split(" ")
        for name in ("COMP_WORDS", "COMP_CWORD", "_TYPER_COMPLETE_ARGS"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv(VARIABLE, f"complete_{shell}")
        if shell == "bash":
            monkeypatch.setenv("COMP_WORDS", typed)
            monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
        else:
            monkeypatch.setenv("_TYPER_COMPLETE_ARGS", typed)
            monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
        said: str = cli().out
        return said.split("\n")[:-1] if shell != "zsh" else said.split('"')[1::2]

    return ask


@pytest.mark.parametrize("shell", SHELLS)
def test_commands_options_and_values(offered: Callable[..., list[str]], shell: str) -> None:
    assert offered("acquire st", shell) == ["start", "stop", "status"]
    assert offered("acquire calibrate da", shell) == ["dark"]
    assert offered("acquire reconstruct take.zarr --pl", shell) == ["--plan"]
    assert offered("acquire status --wait ", shell) == list(STATES)
    assert offered("acquire serve --config rig-f", shell) == ["rig-fast", "rig-fibre"]
    assert "scene-leds" in offered("acquire simulate scene-", shell)
    assert offered("acquire reconstruct take.zarr --plan plan", shell) == ["plan-window"]
    assert offered("acquire config check own", shell) == ["own.toml"]


@pytest.mark.parametrize("shell", SHELLS)
def test_recordings_and_directories_without_names_that_a_shell_would_split(
    offered: Callable[..., list[str]], shell: str, tmp_path: Path
) -> None:
    assert offered("acquire info ", shell) == ["old/", "take.zarr"]
    (tmp_path / "old" / "run.zarr").mkdir()
    assert offered("acquire verify old/", shell) == ["old/run.zarr"]


def test_a_name_that_would_be_an_option_is_no_option(
    offered: Callable[..., list[str]], tmp_path: Path
) -> None:
    (tmp_path / "-x.zarr").mkdir()
    assert offered("acquire info ") == ["./-x.zarr", "old/", "take.zarr"]
    assert offered("acquire info ./") == ["./-x.zarr", "./old/", "./take.zarr"]


def test_the_states_are_the_daemon_s() -> None:
    assert set(STATES) == {*map(str, State), "sealed"}


def test_bash_itself_completes(tmp_path: Path) -> None:
    """The printed script works in its shell."""
    script = (
        'eval "$(acquire completion bash)"\n'
        "COMP_WORDS=(acquire status --wait dr); COMP_CWORD=3\n"
        '_acquire_completion acquire; echo "${COMPREPLY[*]}"; complete -p acquire\n'
    )
    said = shell(tmp_path, "bash", script, "--norc")
    assert said == ["draining", "complete -o default -F _acquire_completion acquire"]


@pytest.mark.parametrize("shell", SHELLS)
def test_each_shell_has_its_script(cli: Cli, shell: str) -> None:
    said = cli("completion", shell).out
    assert f"{VARIABLE}=complete_{shell}" in said


@pytest.mark.needs_fish
def test_fish_itself_completes(tmp_path: Path) -> None:
    said = shell(tmp_path, "fish", "acquire completion fish | source; complete -C 'acquire status --wait dr'")
    assert said == ["draining"]


@pytest.mark.needs_zsh
def test_zsh_itself_completes(tmp_path: Path) -> None:
    """The function's arguments for zsh's own _arguments, which works only inside the line editor."""
    script = (
        "autoload -U compinit; compinit -u -D\n"
        'eval "$(acquire completion zsh)"; print -r -- ${_comps[acquire]}\n'
        '_arguments() { print -r -- "$@" }\n'
        "words=(acquire status --wait dr); CURRENT=4; ${_comps[acquire]}\n"
    )
    assert shell(tmp_path, "zsh", script, "-f") == ["_acquire_completion", '*: :(("draining"))']


def shell(place: Path, name: str, script: str, *options: str) -> list[str]:
    """Return the lines that a script prints in a shell, where `acquire` is this program."""
    found = shutil.which(name)
    assert found is not None
    program = place / "acquire"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m acquire "$@"\n')
    program.chmod(0o755)
    environment = {k: v for k, v in os.environ.items() if k != VARIABLE}
    environment |= {
        "PATH": f"{place}:{environment['PATH']}",
        "HOME": str(place),
        "XDG_CONFIG_HOME": str(place),
    }
    ended = subprocess.run(
        [found, *options, "-c", script],
        cwd=place,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )
    return ended.stdout.splitlines()
