"""Runs the commands: wrong words become the same kind of error as everything else that a user meets."""

from __future__ import annotations

import re
import shutil
import sys
from typing import TYPE_CHECKING, Any

import typer

from acquire.cli.output import say
from acquire.errors import EXIT_INTERRUPTED, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

_WordsError = next(
    kind
    for kind in typer.BadParameter.__mro__
    if issubclass(kind, Exception) and kind.__name__ == "ClickException"
)
"""What typer raises for words that it cannot take: click's, or the copy of click that typer brings."""

NARROW = 80
"""Columns that tables of options need."""
_MARKUP = re.compile(r"\[(bold|/)\]")
_PACKAGES = {"PIL": "pillow"}
"""Modules that are named otherwise than the package that brings them."""
_WHOLE = {"simulate": "simulate", "demo": "report", "paper": "report", "tradeoff": "report", "web": "web"}
"""Command → the extra that brings all that it needs, where several bring what is missing."""
_EXTRA = re.compile(r"extra == ['\"](\w+)['\"]")


def run(app: typer.Typer) -> int:
    """Run the command that the words name; its exit code. Raises UsageError for words that are wrong."""
    try:
        code = _command(app)(standalone_mode=False)
    except typer.Abort:
        return EXIT_INTERRUPTED
    except _WordsError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            say(error.format_message(), err=True)  # type: ignore[attr-defined]
            return UsageError.exit_code
        raise _as_ours(error) from error
    return code if isinstance(code, int) else 0


def _command(app: typer.Typer) -> Any:
    """The commands; on a narrow terminal with plain help, since tables would break words and cut names."""
    command = typer.main.get_command(app)
    if shutil.get_terminal_size().columns < NARROW:
        _make_plain(command)
    return command


def _make_plain(command: Any) -> None:
    command.rich_markup_mode = None
    for name in ("help", "short_help", "epilog"):
        text = getattr(command, name)
        setattr(command, name, text and _MARKUP.sub("", text))
    for below in getattr(command, "commands", {}).values():
        _make_plain(below)


def not_installed(error: ModuleNotFoundError) -> UsageError:
    """The error for a package that is missing, with the extra that the command needs; ours is a defect."""
    module = (error.name or "").partition(".")[0]
    if module == "acquire":
        raise error
    from importlib import metadata

    requirements = metadata.requires("tdi-acquire") or []
    package = _PACKAGES.get(module, module).lower()
    wanted = (one for one in requirements if one.lower().replace("-", "_").startswith(package))
    extras = {found[1] for one in wanted if (found := _EXTRA.search(one))}
    command = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    extras -= {"all", "dev"}
    whole = _WHOLE.get(command, "reconstruct")
    extra = whole if whole in extras else min(extras, default=None)
    return UsageError(
        f"the Python package {module!r}, which this command needs, is not installed",
        hint=f"pip install 'tdi-acquire[{extra}]'" if extra else f"pip install {module}",
    )


def _as_ours(error: Any) -> UsageError:
    """In the voice of all errors: the command, what was wrong with its words, and where help is."""
    context, near = getattr(error, "ctx", None), getattr(error, "possibilities", None)
    command = context.command_path if context is not None else "acquire"
    said = (error.message if near else error.format_message()).partition(" Did you mean")[0].rstrip(".")
    where = f"{command.removeprefix('acquire').lstrip()}: ".removeprefix(": ")
    return UsageError(
        f"{where}{said[:1].lower()}{said[1:]}",
        possible=", ".join(sorted(near) if near else _choices(context)),
        hint=f"{command} --help",
    )


def _choices(context: Any) -> Iterator[str]:
    """The commands of a group whose name alone was given, or one that is none of them."""
    commands = getattr(context.command, "commands", {}) if context is not None else {}
    yield from commands
