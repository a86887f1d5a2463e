"""The base of all configuration models: what they refuse, and the bounds of plausible values."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

# As many as Linux allows in a path (PATH_MAX).
MOST_CHARACTERS = 4096
"""Longest text in a file, such as a path, a URL or a name."""
MOST_SECONDS = 1e9
"""Thirty years; a longer time is a typing error."""
MOST_DN = 1e9
# Beyond this, JSON readers that know floats only are not exact.
MOST_LINES = 2**53
SEED_END = 2**128
"""Upper bound of seeds, which are stored in every recording as JSON."""


class FrozenModel(BaseModel):
    """An immutable model that refuses unknown keys, non-finite numbers and values of another type.

    ``true`` is not accepted as a number, nor ``"64"`` or ``64.0`` as a count.
    """

    # Strict, since a rig with `stages = true`, which pydantic otherwise takes for 1, failed only when it was
    # armed.
    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, strict=True, str_max_length=MOST_CHARACTERS
    )

    @model_validator(mode="before")
    @classmethod
    def _lists_are_tuples(cls, table: Any) -> Any:
        """Turn a file's lists, and the lists in them, into tuples, since the model is immutable."""
        if not isinstance(table, dict):
            return table
        # A strict model takes no list for a tuple, and TOML has only lists.
        return {key: _tuples(value) if isinstance(value, list) else value for key, value in table.items()}


def _tuples(items: list[Any]) -> tuple[Any, ...]:
    # Also the lists in a list: a camera's settings are such a list.
    return tuple(_tuples(item) if isinstance(item, list) else item for item in items)


def _without_null(path: Path) -> Path:
    if "\0" in str(path):
        raise ValueError("a path cannot contain a null character")
    return path


# Not strict: pydantic would accept objects of the class Path only, and a file holds texts.
FilePath = Annotated[Path, Field(strict=False), AfterValidator(_without_null)]
"""A path, written as text in files."""
Seconds = Annotated[float, Field(ge=0, le=MOST_SECONDS)]
"""A duration of plausible length."""
Positive = Annotated[float, Field(gt=0)]
Part = Annotated[float, Field(ge=0, le=1)]
