"""Tab in bash, zsh and fish: ``acquire completion SHELL``, and what is offered for the words of commands.

The functions are called while a word is being typed: they import little, and what they cannot find out, or
what a shell could take for more than a name, they leave out.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from acquire.cli.output import say
from acquire.cli.words import PROGRAM, VARIABLE

if TYPE_CHECKING:
    from collections.abc import Iterable

_PLAIN_NAME = re.compile(r"[\w.@+=,~-]+")
STATES = ("idle", "armed", "recording", "draining", "faulted", "sealed")


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Rig")(completion)


def completion(
    shell: Annotated[
        Literal["bash", "zsh", "fish"], typer.Argument(metavar="SHELL", help="Shell: bash, zsh or fish.")
    ],
) -> None:
    """Print the script that lets Tab complete commands, options, configurations, states and recordings.

    For bash: eval "$(acquire completion bash)" in ~/.bashrc. For zsh the same with zsh in ~/.zshrc, after
    compinit. For fish: acquire completion fish > ~/.config/fish/completions/acquire.fish

    Example: [bold]acquire completion bash[/]
    """
    from typer.completion import get_completion_script  # type: ignore[attr-defined]

    script = get_completion_script(prog_name=PROGRAM, complete_var=VARIABLE, shell=shell)
    for line in script.strip().splitlines():
        say(line)


def words_so_far() -> list[str]:
    """The words before the one that is being typed, as the scripts hand them over."""
    typed = os.environ.get("COMP_WORDS")  # bash; zsh and fish have typer's own variable
    if typed is not None:
        words = typed.split()
        return words[1 : int(os.environ.get("COMP_CWORD", len(words)))]
    typed = os.environ.get("_TYPER_COMPLETE_ARGS", "")
    words = typed.split()[1:]
    return words if typed.endswith(" ") else words[:-1]


def complete(command: Any) -> int:
    """Print what fits the words in the environment; the exit code."""
    from typer.completion import completion_init  # type: ignore[attr-defined]

    completion_init()
    _without_help(command)
    try:
        command(args=[], prog_name=PROGRAM, complete_var=VARIABLE)
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 1
    return 0


def _without_help(command: Any) -> None:
    """Names alone: to show help beside them costs half a second for every Tab, and breaks lines in fish."""
    command.help = command.short_help = None
    for parameter in command.params:
        parameter.help = None
    for below in getattr(command, "commands", {}).values():
        _without_help(below)


def states(incomplete: str) -> list[str]:
    """Of the daemon, and ``sealed``: see `acquire.daemon.states`."""
    return [state for state in STATES if state.startswith(incomplete)]


def recordings(incomplete: str) -> list[str]:
    """Recordings and videos (NAME.zarr), and directories on the way to them."""
    return _paths(incomplete, (".zarr",))


def rigs(incomplete: str) -> list[str]:
    """Built-in rigs, and TOML files."""
    return _configurations(incomplete, "rig-")


def scenes(incomplete: str) -> list[str]:
    """Built-in scenes, TOML files, and what else a scene can be made of."""
    return [*_built_in(incomplete, "scene-"), *_paths(incomplete, (".toml", ".npy", ".png", ".mp4"))]


def plans(incomplete: str) -> list[str]:
    """Built-in plans, and TOML files."""
    return _configurations(incomplete, "plan-")


def configurations(incomplete: str) -> list[str]:
    """Built-in rigs, scenes and plans, and TOML files."""
    return _configurations(incomplete, "")


def _configurations(incomplete: str, kind: str) -> list[str]:
    return [*_built_in(incomplete, kind), *_paths(incomplete, (".toml",))]


def _built_in(incomplete: str, kind: str) -> list[str]:
    from acquire.place import builtin_names

    return [name for name in builtin_names(kind) if name.startswith(incomplete)]


def _paths(incomplete: str, suffixes: Iterable[str]) -> list[str]:
    """Files and directories that begin so and end so, and directories, which may hold more."""
    parent, _, begun = incomplete.rpartition("/")
    base = Path(f"{parent}/" if incomplete.startswith("/") or parent else ".")
    found = []
    with suppress(OSError):
        for path in sorted(base.iterdir()):
            hidden = path.name.startswith(".") and not begun
            if hidden or not path.name.startswith(begun) or not _PLAIN_NAME.fullmatch(path.name):
                continue
            word = f"{parent}/{path.name}" if "/" in incomplete else path.name
            if path.name.endswith(tuple(suffixes)):
                found.append(word)
            elif path.is_dir():
                found.append(f"{word}/")
    return found
