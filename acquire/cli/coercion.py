"""Coercion of option values without pydantic, whose import takes longer than the command `status`.

Typer builds a pydantic validator for every option of a command, even for options that were not given. Here
absent values stay absent, and texts, paths and numbers are converted directly. Other types, and values that
cannot be converted, are passed to typer's own validator, which also formats the error.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

PLAIN = (str, Path, int, float, bool)
_NOT = {int: "{} is not a whole number", float: "{} is not a number", Path: "{} is not a path"}
_CHECKS = ("exists", "writable", "resolve_path", "allow_dash", "path_type", "click_type")
"""Properties of an option whose values typer must validate itself: a path that has to exist, for example."""


def range_in_words(least: float | None, most: float | None) -> str:
    """Return `1 to 9`, `1 or more` or `9 or less`; an empty text without limits."""
    # In full: `1.04858e+06` is neither the limit nor what anybody would type.
    low, high = ("" if limit is None else f"{limit:.15g}" for limit in (least, most))
    if least is None:
        return high and f"{high} or less"
    return f"{low} or more" if most is None else f"{low} to {high}"


class Quick:
    """Converts the values of one option; ``_slow`` builds typer's own validator."""

    def __init__(self, parameter: Any) -> None:
        self._slow = parameter.get_runtime_param
        about = parameter.type_descriptor
        info = about.parameter_info
        checked = about.is_file or about.is_choice or any(getattr(info, name, None) for name in _CHECKS)
        kind = info.parser or (about.annotation if about.annotation in PLAIN else None)
        self._type: Any = None if checked else kind
        self._least, self._most = info.min, info.max

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the converted value. Raises typer.BadParameter if it is invalid or out of range."""
        several = param.multiple or param.nargs == -1
        if value is None and not several:
            return None
        # click has made a bool of a flag already.
        if isinstance(value, bool) and self._type is bool:
            return value
        # What needs more than a conversion is left to typer: its validator takes long to build, but is right.
        if self._type in (None, bool) or several:
            return self._slow().coerce(value, param=param, ctx=ctx)
        if self._type is Path and value == "":
            # As of a shell's variable that is not set. Python takes it for the current directory.
            raise typer.BadParameter("the path is empty", ctx=ctx, param=param)
        try:
            found = self._type(value)
        except typer.BadParameter:  # of a parser of ours: typer calls it again and adds the option's name
            return self._slow().coerce(value, param=param, ctx=ctx)
        except ValueError:
            raise typer.BadParameter(_NOT[self._type].format(repr(value)), ctx=ctx, param=param) from None
        least, most = self._least, self._most
        if not (least is None or found >= least) or not (most is None or found <= most):  # true for nan, too
            possible = range_in_words(least, most)
            raise typer.BadParameter(f"{found} is out of range: {possible}", ctx=ctx, param=param)
        return found


def use_quick_coercion(command: Any) -> None:
    """Replace the validators of a command and its subcommands; unknown versions of typer are left alone."""
    for parameter in command.params:
        _replace(parameter)
    # The option for help is made only when it is needed, after this.
    makes_help = command.get_help_option
    command.get_help_option = lambda ctx: _replace(makes_help(ctx))
    for below in getattr(command, "commands", {}).values():
        use_quick_coercion(below)


def _replace(parameter: Any) -> Any:
    known = hasattr(parameter, "get_runtime_param") and hasattr(parameter, "type_descriptor")
    if known and not hasattr(parameter, "quick"):
        parameter.quick = quick = Quick(parameter)
        parameter.get_runtime_param = lambda: quick
    return parameter
