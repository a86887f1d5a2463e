"""What every worker and its owner say to each other, whatever the work."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from acquire.errors import AcquireError


@dataclass(frozen=True, slots=True)
class Ready:
    """The process has what it needs; a grabber tells who its camera is and how it is set."""

    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Failed:
    """The process ends because of this."""

    error: AcquireError


@dataclass(frozen=True, slots=True)
class Quit:
    """Finish what is under way and end."""
