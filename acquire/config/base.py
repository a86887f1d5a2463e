"""What all configuration models have in common: what they refuse, and the bounds of reason."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

MOST_CHARACTERS = 4096
"""Of any text in a file: a path, a URL, a name."""
MOST_SECONDS = 1e9
"""Thirty years; a longer time is a slip of the finger."""
MOST_DN = 1e9
MOST_LINES = 2**53
SEED_END = 2**128
"""Seeds go into every recording, as JSON."""


class FrozenModel(BaseModel):
    """Unknown keys and non-finite numbers are refused, and so are values of another type: ``true`` is no
    number, ``"64"`` and ``64.0`` are no counts. Values do not change.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, strict=True, str_max_length=MOST_CHARACTERS
    )

    @model_validator(mode="before")
    @classmethod
    def _lists_are_tuples(cls, table: Any) -> Any:
        """A file's lists, and their lists, are what cannot change here."""
        if not isinstance(table, dict):
            return table
        return {key: _tuples(value) if isinstance(value, list) else value for key, value in table.items()}


def _tuples(items: list[Any]) -> tuple[Any, ...]:
    return tuple(_tuples(item) if isinstance(item, list) else item for item in items)


FilePath = Annotated[Path, Field(strict=False)]
"""A path; files write it as text."""
Seconds = Annotated[float, Field(ge=0, le=MOST_SECONDS)]
"""A duration, within reason."""
Positive = Annotated[float, Field(gt=0)]
Part = Annotated[float, Field(ge=0, le=1)]
