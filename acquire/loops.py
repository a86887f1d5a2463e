"""Loops that numba compiles once after an installation, or once per run if no directory takes them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numba

from acquire.scratch import PREFIX, scratch_directory

if TYPE_CHECKING:
    from collections.abc import Callable


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a loop on its first call, with numba's options, and keeps it."""

    def decorate(loop: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(loop)
        except RuntimeError:
            # Neither the package's directory nor the user's home takes files, as for a service's account.
            # Processes that this one starts learn from its environment where compiled loops are.
            numba.config.CACHE_DIR = scratch_directory()  # type: ignore[attr-defined]
            os.environ["NUMBA_CACHE_DIR"] = scratch_directory()
            return numba.njit(cache=True, **options)(loop)

    return decorate


def how_often() -> str:
    """Return how often loops are compiled, for a user who has waited for it."""
    if Path(os.environ.get("NUMBA_CACHE_DIR", "")).name.startswith(PREFIX):
        return "in every run, unless NUMBA_CACHE_DIR names a directory that this user may write to"
    return "once per installation"
