"""Libraries that only one file format needs."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from acquire.errors import UsageError


def library(module: str, extra: str, what: str) -> Any:
    """Import a module. Raises UsageError with the command that installs it if it is missing."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        # The package may be there and lack one that it needs itself: that one is named.
        raise UsageError(
            f"{what} needs the Python package {error.name or module!r}, which is not installed",
            hint=f"pip install 'tdi-acquire[{extra}]'",
        ) from error
