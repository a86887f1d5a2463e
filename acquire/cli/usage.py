"""Runs the commands: wrong words become the same kind of error as everything else that a user meets."""

from __future__ import annotations

import importlib
import os
import re
import sys
from typing import TYPE_CHECKING, Any

import typer

from acquire.cli.coercion import ease
from acquire.cli.commands import BY_NAME, MODULES
from acquire.cli.help import EXAMPLE, SUMMARY, make_plain, overview
from acquire.cli.output import say
from acquire.cli.words import VARIABLE
from acquire.errors import EXIT_INTERRUPTED, UsageError
from acquire.text import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

_WordsError = next(
    kind
    for kind in typer.BadParameter.__mro__
    if issubclass(kind, Exception) and kind.__name__ == "ClickException"
)
"""What typer raises for words that it cannot take: click's, or the copy of click that typer brings."""

_EXTRA = re.compile(r"extra == ['\"](\w+)['\"]")
_HELP = ("-h", "--help")
_PACKAGES = {"PIL": "pillow"}
"""Modules that are named otherwise than the package that brings them."""
_WHOLE = {"simulate": "simulate", "demo": "report", "paper": "report", "tradeoff": "report", "web": "web"}
"""Command → the extra that brings all that it needs, where several bring what is missing."""


def build(modules: Iterable[str] = MODULES) -> typer.Typer:
    """The commands of some modules of `acquire.cli`, or all of them."""
    app = typer.Typer(
        name="acquire",
        help=SUMMARY,
        epilog=EXAMPLE,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": list(_HELP)},
    )
    app.callback()(_options)
    for module in modules:
        importlib.import_module(f"acquire.cli.{module}").register(app)
    return app


def run(words: Sequence[str]) -> int:
    """Run the command that the words name; its exit code. Raises UsageError for words that are wrong."""
    if VARIABLE in os.environ:
        # What Tab offers: of the command that is there already, or of all.
        from acquire.cli.completion import complete, words_so_far

        before = [word for word in words_so_far() if not word.startswith("-")][:1]
        modules = {BY_NAME[word].module for word in before if word in BY_NAME} or MODULES
        return complete(command_of(modules))
    first = words[0] if words else ""
    if first in ("", *_HELP):
        say_lines(overview(), err=not first)
        return 0 if first else UsageError.exit_code
    if first == "--version":
        from acquire import __version__

        say(__version__)
        return 0
    try:
        code = command_of(_module_of(first))(args=list(words), prog_name="acquire", standalone_mode=False)
    except typer.Abort:
        return EXIT_INTERRUPTED
    except _WordsError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            say_lines(error.format_message(), err=True)  # type: ignore[attr-defined]
            return UsageError.exit_code
        raise _as_ours(error) from error
    return code if isinstance(code, int) else 0


def say_lines(text: str, *, err: bool = False) -> None:
    """Several lines of our own."""
    for line in text.splitlines():
        say(line, err=err)


def command_of(modules: Iterable[str]) -> Any:
    """The commands of some modules, ready to be called: help in plain words, and values taken quickly."""
    command = typer.main.get_command(build(modules))
    make_plain(command)
    ease(command)
    return command


def _module_of(word: str) -> tuple[str, ...]:
    if word in BY_NAME:
        return (BY_NAME[word].module,)
    what = "there is no option" if word.startswith("-") else "there is no command"
    shown = f" {word}" if word.startswith("-") else f" {word!r}"
    known = ("--version", *_HELP) if word.startswith("-") else tuple(BY_NAME)
    raise UsageError(
        f"{what}{shown}{did_you_mean(word, known)}", possible=", ".join(sorted(known)), hint="acquire --help"
    )


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
    mistaken = said.partition("'")[2].partition("'")[0]  # the word that click quotes
    meant = f"; did you mean {near[0]!r}?" if near else did_you_mean(mistaken, _choices(context))
    return UsageError(
        f"{where}{_sentence(said[:1].lower() + said[1:])}{meant}",
        possible=", ".join(sorted(near) if near else _choices(context)),
        hint=f"{command} --help",
    )


def _sentence(said: str) -> str:
    """With a verb where click has none."""
    said = re.sub(r"^no such (option|command):? ", r"there is no \1 ", said)
    return re.sub(r"^missing ((?:option|argument) .*)", r"the \1 is missing", said)


def _choices(context: Any) -> Iterator[str]:
    """The commands of a group whose name alone was given, or one that is none of them."""
    commands = getattr(context.command, "commands", {}) if context is not None else {}
    yield from commands


def _options(
    version: bool = typer.Option(False, "--version", help="Print the version and end."),
) -> None:
    """Options of the program itself; `run` answers them."""
