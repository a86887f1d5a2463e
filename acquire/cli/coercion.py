"""Values of options without pydantic, where nothing has to be checked: its import takes longer than `status`.

Typer builds a validator of pydantic's for every option of a command, also for those that nobody gave. Here
absent values stay absent, and texts, paths and numbers are taken as they are; whatever else there is, and
whatever is wrong, goes to typer's own validator, which has the words for it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

PLAIN = (str, Path, int, float, bool)
_NOT = {int: "{} is not a whole number", float: "{} is not a number", Path: "{} is not a path"}


class Quick:
    """Takes the values of one option; ``slow`` makes typer's own way of taking them."""

    def __init__(self, parameter: Any) -> None:
        self._slow = parameter.get_runtime_param
        about = parameter.type_descriptor
        checked = about.is_file or about.is_choice or _checked(about.parameter_info)
        kind = about.parameter_info.parser or (about.annotation if about.annotation in PLAIN else None)
        self._type: Any = None if checked else kind
        self._least, self._most = about.parameter_info.min, about.parameter_info.max

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        several = param.multiple or param.nargs == -1
        if value is None and not several:
            return None
        if isinstance(value, bool) and self._type is bool:
            return value
        try:
            if self._type not in (None, bool) and not several:
                return self._within(self._type(value), ctx, param)
        except OutOfRange:
            raise
        except typer.BadParameter:
            pass  # it is raised again, with the option's name
        except ValueError:
            raise typer.BadParameter(_NOT[self._type].format(repr(value)), ctx=ctx, param=param) from None
        return self._slow().coerce(value, param=param, ctx=ctx)

    def _within(self, value: Any, ctx: Any, param: Any) -> Any:
        """The value. typer.BadParameter where it is out of the option's range."""
        least, most = self._least, self._most
        if not (least is None or value >= least) or not (most is None or value <= most):  # nan is neither
            possible = f"{most:g} or less" if least is None else f"{least:g} or more"
            if least is not None and most is not None:
                possible = f"{least:g} to {most:g}"
            raise OutOfRange(f"{value} is out of range: {possible}", ctx=ctx, param=param)
        return value


class OutOfRange(typer.BadParameter):
    """A number that is one, and not in the range of its option."""


def ease(command: Any) -> None:
    """Have a command, and those below it, take values quickly; other versions of typer are left alone."""
    for parameter in command.params:
        _ease(parameter)
    makes_help = command.get_help_option
    command.get_help_option = lambda ctx: _ease(makes_help(ctx))
    for below in getattr(command, "commands", {}).values():
        ease(below)


def _ease(parameter: Any) -> Any:
    known = hasattr(parameter, "get_runtime_param") and hasattr(parameter, "type_descriptor")
    if known and not hasattr(parameter, "quick"):
        parameter.quick = quick = Quick(parameter)
        parameter.get_runtime_param = lambda: quick
    return parameter


def _checked(about: Any) -> bool:
    """A path that must exist, be readable, and so on."""
    asks = ("exists", "writable", "resolve_path", "allow_dash", "path_type", "click_type")
    return any(getattr(about, name, None) for name in asks)
