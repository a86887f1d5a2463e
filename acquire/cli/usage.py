"""Builds and runs the commands. Mistakes on the command line raise the same errors as everything else."""

from __future__ import annotations

import functools
import importlib
import os
import re
import sys
from typing import TYPE_CHECKING, Any

import typer

from acquire.cli.coercion import use_quick_coercion
from acquire.cli.commands import BY_NAME, MODULES
from acquire.cli.help import EXAMPLE, SUMMARY, make_plain, overview
from acquire.cli.output import print_warning, say
from acquire.cli.words import VARIABLE
from acquire.errors import EXIT_INTERRUPTED, UsageError
from acquire.text import did_you_mean, own_words

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_ParseError = next(
    kind
    for kind in typer.BadParameter.__mro__
    if issubclass(kind, Exception) and kind.__name__ == "ClickException"
)
"""Base class of typer's parsing errors. It is defined in click, or in the copy of click inside typer."""

_EXTRA = re.compile(r"extra == ['\"](\w+)['\"]")
_HELP = ("-h", "--help")
_PACKAGES = {"PIL": "pillow"}
"""Modules whose name differs from that of their package."""
_WHOLE = {"simulate": "simulate", "demo": "report", "paper": "report", "tradeoff": "report", "web": "web"}
"""Command → the extra that installs everything it needs, for packages that several extras install."""


def build(modules: Iterable[str] = MODULES) -> typer.Typer:
    """Build the application with the commands of the given modules of `acquire.cli` (default: all)."""
    app = typer.Typer(
        name="acquire",
        help=SUMMARY,
        epilog=EXAMPLE,
        no_args_is_help=True,
        # `acquire completion` and `main` do these in our own words, as text or JSON.
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": list(_HELP)},
    )
    app.callback()(_options)
    for module in modules:
        importlib.import_module(f"acquire.cli.{module}").register(app)
    return app


def run(words: Sequence[str]) -> int:
    """Run a command line and return its exit code. Raises UsageError if it cannot be parsed."""
    if VARIABLE in os.environ:
        # The shell asks for completions: those of the command typed so far, or of all commands.
        from acquire.cli.completion import complete, words_so_far

        before = [word for word in words_so_far() if not word.startswith("-")][:1]
        # Importing all commands for every Tab would be felt.
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
    if first not in BY_NAME:
        is_option = first.startswith("-")
        what = f"there is no option {first}" if is_option else f"there is no command {first!r}"
        known = ("--version", *_HELP) if is_option else tuple(BY_NAME)
        # `help start`, and `--config RIG serve`: options come after the command.
        later = next((word for word in words[1:] if word in BY_NAME), "")
        command = later if first == "help" or is_option else ""
        raise UsageError(
            f"{what}{did_you_mean(first, known)}",
            possible=", ".join(sorted(known)),
            hint=" ".join(filter(None, ("acquire", command, "--help"))),
        )
    # This module alone: a command need not wait for the imports of all others.
    command = command_of([BY_NAME[first].module])
    try:
        # Not standalone: errors come back to `main`, which prints them.
        code = command(args=list(words), prog_name="acquire", standalone_mode=False)
    except typer.Abort:
        return EXIT_INTERRUPTED
    except _ParseError as error:
        # A group without a subcommand prints its help, which is this error's message.
        if type(error).__name__ == "NoArgsIsHelpError":
            say_lines(error.format_message(), err=True)  # type: ignore[attr-defined]
            return UsageError.exit_code
        raise _usage_error(error, f"acquire {first}") from error
    return code if isinstance(code, int) else 0


def say_lines(text: str, *, err: bool = False) -> None:
    """Print a text of several lines."""
    for line in text.splitlines():
        say(line, err=err)


def command_of(modules: Iterable[str]) -> Any:
    """Return the click command of some modules, with plain help and quick coercion of option values."""
    command = typer.main.get_command(build(modules))
    make_plain(command)
    use_quick_coercion(command)
    _tell_second_values(command)
    return command


def _tell_second_values(command: Any) -> None:
    """Warn of two different values of one option, of which the last counts, as in an alias that has defaults.

    Repeatable options are left alone, and so are the same value given twice, environment variables and
    defaults.
    """
    make_parser = command.make_parser

    def make(context: Any) -> Any:
        parser = make_parser(context)
        # For completions, a command line is read as far as it goes.
        if not context.resilient_parsing:
            # The option objects of an unknown version of click are left alone.
            names = {**getattr(parser, "_short_opt", {}), **getattr(parser, "_long_opt", {})}
            for option in {id(each): each for each in names.values()}.values():
                option.process = functools.partial(_process, option, option.process, context)
        return parser

    command.make_parser = make
    for below in getattr(command, "commands", {}).values():
        _tell_second_values(below)


def _process(option: Any, process: Any, context: Any, value: Any, state: Any) -> None:
    if option.action == "store" and (before := state.opts.get(option.dest, value)) != value:
        *others, name = sorted(option.obj.opts, key=len)
        also = f" ({' or '.join(others)})" if others else ""
        words = context.command_path.removeprefix("acquire").lstrip()
        print_warning(f"{words}: {name}{also} is given twice: {value} counts, not {before}")
    process(value, state)


def not_installed(error: ModuleNotFoundError) -> UsageError:
    """Return the error for a missing package, which names the extra to install.

    A missing module of ``acquire`` itself is a defect of ours: its error is raised again.
    """
    module = (error.name or "").partition(".")[0]
    if module == "acquire":
        raise error
    from importlib import metadata

    requirements = metadata.requires("tdi-acquire") or []
    package = _PACKAGES.get(module, module).lower()
    # Distributions have hyphens where modules have underscores.
    wanted = (one for one in requirements if one.lower().replace("-", "_").startswith(package))
    extras = {found[1] for one in wanted if (found := _EXTRA.search(one))}
    command = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    # These bring everything; a smaller one will do.
    extras -= {"all", "dev"}
    whole = _WHOLE.get(command, "reconstruct")
    extra = whole if whole in extras else min(extras, default=None)
    return UsageError(
        f"the Python package {module!r}, which this command needs, is not installed",
        hint=f"pip install 'tdi-acquire[{extra}]'" if extra else f"pip install {module}",
    )


def _usage_error(error: Any, command: str) -> UsageError:
    """Rewrite one of click's errors in our own style: the command, the mistake, and where to find help."""
    context, near = getattr(error, "ctx", None), getattr(error, "possibilities", None)
    # click's parser does not say whose option lacks its value
    command = context.command_path if context is not None else command
    where = f"{command.removeprefix('acquire').lstrip()}: ".removeprefix(": ")
    message = own_words(error.message if near else error.format_message())
    # What was probably meant is added below, in our own words.
    message = message.partition(" Did you mean")[0].rstrip(".")
    # click's messages have no verb in these two cases
    sentence = message[:1].lower() + message[1:]
    sentence = re.sub(r"^no such (option|command):? ", r"there is no \1 ", sentence)
    # With the choices of an enumeration, which is listed line by line.
    sentence, _, choices_text = sentence.partition(". Choose from:")
    sentence = re.sub(r"^missing ((?:option|argument) .*)", r"the \1 is missing", sentence)
    sentence = re.sub(r"^got unexpected extra argument\S* \((.*)\)$", r"'\1' is more than it takes", sentence)
    # for a group of commands whose subcommand is missing or unknown
    choices = list(getattr(context.command, "commands", {})) if context is not None else []
    mistaken = message.partition("'")[2].partition("'")[0]  # the word that click quotes
    meant = f"; did you mean {near[0]!r}?" if near else did_you_mean(mistaken, choices)
    possible = ", ".join(sorted(near) if near else choices)
    usage = _usage(context)
    if choices_text:
        possible = " ".join(choices_text.split())
    if usage and sentence == "there is no option --out":
        # Other commands have it, and the nearest option, --to, is a time.
        possible, meant = usage, ": the output is an argument"
    elif "argument" in message:
        possible = possible or usage
    return UsageError(f"{where}{sentence}{meant}", possible=possible, hint=f"{command} --help")


def _usage(context: Any) -> str:
    """Return how a command with arguments is called; an empty text for one without."""
    if context is None or not any(each.param_type_name == "argument" for each in context.command.params):
        return ""
    return " ".join([context.command_path, *context.command.collect_usage_pieces(context)])


def _options(
    version: bool = typer.Option(False, "--version", help="Print the version and exit."),
) -> None:
    """Declare the options of the program itself, which `run` handles."""
