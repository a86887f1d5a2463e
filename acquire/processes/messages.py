"""Messages between every worker and its owner."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from acquire.errors import AcquireError


@dataclass(frozen=True, slots=True)
class Ready:
    """The process is ready; a grabber's ``facts`` are its camera's identity and settings."""

    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Failed:
    """The process ends because of this."""

    error: AcquireError


@dataclass(frozen=True, slots=True)
class Quit:
    """Finish the current work and end."""
