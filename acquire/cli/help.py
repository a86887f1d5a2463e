"""Help as plain text that fits the terminal: it needs no library and truncates nothing."""

from __future__ import annotations

import re
import shutil
import textwrap
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.cli.coercion import range_in_words
from acquire.cli.commands import COMMANDS
from acquire.cli.output import say

if TYPE_CHECKING:
    from collections.abc import Iterator

SUMMARY = "Record and reconstruct TDI-based compressed video."
EXAMPLE = (
    "Example: acquire serve --config rig-demo, then in another terminal: "
    "acquire arm, acquire start --duration 2s"
)
OPTIONS = (
    ("--version", "Print the version and exit."),
    ("-h, --help", "Show this help, or after a command the help of that command."),
)
WIDEST = 120
"""Longer lines are hard to read."""
NAMES = max(len(command.name) for command in COMMANDS)
VALUES = {int: "N", float: "NUMBER", Path: "PATH"}
"""What help calls a value of each type. Not of texts, whose options each say what they take (`metavar`)."""
_MARKUP = re.compile(r"\[(bold|/)\]")


def columns() -> int:
    """Return the width for help text: that of the terminal, at most `WIDEST`."""
    return min(WIDEST, shutil.get_terminal_size().columns)


def overview() -> str:
    """Return the program's help, with the commands grouped by purpose."""
    lines = ["Usage: acquire COMMAND [OPTIONS]...", "", SUMMARY, "", "Options:", *_rows(OPTIONS)]
    for panel, commands in groupby(COMMANDS, lambda command: command.panel):
        lines += ["", f"{panel}:", *_rows((command.name, command.summary) for command in commands)]
    lines += ["", *textwrap.wrap(EXAMPLE, columns(), break_on_hyphens=False)]
    return "\n".join(lines)


def _rows(rows: Any) -> Iterator[str]:
    for name, text in rows:
        yield from textwrap.wrap(
            text,
            columns(),
            initial_indent=f"  {name:<{NAMES}}  ",
            subsequent_indent=" " * (NAMES + 4),
            # Options have hyphens in their names.
            break_on_hyphens=False,
        )


def make_plain(command: Any) -> None:
    """Make a command and its subcommands print their help as plain text, as wide as the terminal."""
    # rich takes most of a help's time, and its tables do not fit a narrow terminal.
    command.rich_markup_mode = None
    command.context_settings["max_content_width"] = columns()
    for name in ("help", "short_help", "epilog"):
        # The help texts have marks for rich, which does not print them here.
        text = getattr(command, name)
        setattr(command, name, text and _MARKUP.sub("", text))
    if command.help and not command.short_help:
        # Without a summary click takes the help's beginning, cut to a line of the list.
        command.short_help = command.help.partition("\n\n")[0].replace("\n", " ")
    for parameter in command.params:
        _name_value(parameter)
    makes_help = command.get_help_option
    command.get_help_option = lambda ctx: _saying(makes_help(ctx))
    for below in getattr(command, "commands", {}).values():
        make_plain(below)


def _saying(option: Any) -> Any:
    """Let the option for help print as all commands do, so that an error of standard output names that."""

    def say_help(ctx: Any, _option: Any, wanted: bool) -> None:
        if wanted and not ctx.resilient_parsing:
            for line in ctx.get_help().splitlines():
                say(line)
            ctx.exit()

    if option is not None:
        option.callback = say_help
    return option


def _name_value(parameter: Any) -> None:
    """Let help name a parameter's value in words; typer has `<int range>`, and `x>=0` for a range."""
    about = getattr(parameter, "type_descriptor", None)
    if about is None:  # of a version of typer without it, whose own names will do
        return
    if parameter.param_type_name == "argument":
        # Its name is enough, such as RECORDING: typer would add the type.
        parameter.display_type_rich = lambda ctx: None  # noqa: ARG005
    elif parameter.metavar is None:
        parameter.metavar = "|".join(about.choices) if about.is_choice else VALUES.get(about.annotation)
    limits = about.parameter_info
    parameter._get_number_range_help_str = lambda: range_in_words(limits.min, limits.max)
