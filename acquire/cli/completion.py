"""Tab completion in bash, zsh and fish: ``acquire completion SHELL``, and the completions of arguments.

The completion functions run while a word is being typed, so they import little. They leave out anything that
they cannot determine, and names with characters that a shell could interpret.
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
# Not taken from the daemon's module, which would be imported for every Tab.
STATES = ("idle", "armed", "recording", "draining", "faulted", "sealed")


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Rig")(completion)


def completion(
    shell: Annotated[
        Literal["bash", "zsh", "fish"],
        typer.Argument(metavar="SHELL", help="Your shell: bash, zsh or fish."),
    ],
) -> None:
    """Print the script for Tab completion of commands, options, configurations, states and recordings.

    For bash, add eval "$(acquire completion bash)" to ~/.bashrc. For zsh, add the same line with zsh to
    ~/.zshrc, after compinit. For fish: acquire completion fish > ~/.config/fish/completions/acquire.fish

    Example: [bold]acquire completion bash[/]
    """
    from typer.completion import get_completion_script  # type: ignore[attr-defined]

    script = get_completion_script(prog_name=PROGRAM, complete_var=VARIABLE, shell=shell)
    for line in script.strip().splitlines():
        say(line)


def words_so_far() -> list[str]:
    """Return the words before the one being typed, as passed by the completion script."""
    typed = os.environ.get("COMP_WORDS")  # set by bash; zsh and fish use typer's own variable
    if typed is not None:
        words = typed.split()
        return words[1 : int(os.environ.get("COMP_CWORD", len(words)))]
    typed = os.environ.get("_TYPER_COMPLETE_ARGS", "")
    words = typed.split()[1:]
    # After a space the word being typed is a new one, of which nothing is there yet.
    return words if typed.endswith(" ") else words[:-1]


def complete(command: Any) -> int:
    """Print the completions of the command line in the environment; return the exit code."""
    from typer.completion import completion_init  # type: ignore[attr-defined]

    completion_init()
    _without_help(command)
    try:
        command(args=[], prog_name=PROGRAM, complete_var=VARIABLE)
    # typer exits the process itself.
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 1
    return 0


def _without_help(command: Any) -> None:
    """Remove the help texts: showing them costs half a second for every Tab, and breaks lines in fish."""
    command.help = command.short_help = None
    for parameter in command.params:
        parameter.help = None
    for below in getattr(command, "commands", {}).values():
        _without_help(below)


def states(incomplete: str) -> list[str]:
    """Complete the daemon's states and ``sealed``, see `acquire.daemon.states`."""
    return [state for state in STATES if state.startswith(incomplete)]


def recordings(incomplete: str) -> list[str]:
    """Complete recordings and videos (NAME.zarr), and directories that may contain some."""
    return _paths(incomplete, (".zarr",))


def rigs(incomplete: str) -> list[str]:
    """Complete built-in rigs and TOML files."""
    return _configurations(incomplete, "rig-")


def scenes(incomplete: str) -> list[str]:
    """Complete built-in scenes, TOML files, and other files that a scene can be made from."""
    return [*_built_in(incomplete, "scene-"), *_paths(incomplete, (".toml", ".npy", ".png", ".mp4"))]


def plans(incomplete: str) -> list[str]:
    """Complete built-in plans and TOML files."""
    return _configurations(incomplete, "plan-")


def configurations(incomplete: str) -> list[str]:
    """Complete built-in rigs, scenes and plans, and TOML files."""
    return _configurations(incomplete, "")


def _configurations(incomplete: str, kind: str) -> list[str]:
    return [*_built_in(incomplete, kind), *_paths(incomplete, (".toml",))]


def _built_in(incomplete: str, kind: str) -> list[str]:
    from acquire.place import builtin_names

    return [name for name in builtin_names(kind) if name.startswith(incomplete)]


def _paths(incomplete: str, suffixes: Iterable[str]) -> list[str]:
    """Complete paths with one of the suffixes, and other directories, which may contain some."""
    parent, _, begun = incomplete.rpartition("/")
    # Before the only slash of "/x" there is as little as before a name without one.
    base = Path(f"{parent}/" if incomplete.startswith("/") or parent else ".")
    found = []
    # Nothing to offer is better than a traceback in the middle of a command line.
    with suppress(OSError):
        for path in sorted(base.iterdir()):
            # As shells do: hidden names are offered once a dot has been typed.
            hidden = path.name.startswith(".") and not begun
            if hidden or not path.name.startswith(begun) or not _PLAIN_NAME.fullmatch(path.name):
                continue
            word = f"{parent}/{path.name}" if "/" in incomplete else path.name
            if word.startswith("-"):  # it would be an option
                word = f"./{word}"
            if path.name.endswith(tuple(suffixes)):
                found.append(word)
            elif path.is_dir():
                found.append(f"{word}/")
    return found
