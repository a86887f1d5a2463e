"""Models of a rig's ``[service]`` and ``[hooks]``: what the daemon does on its own, and whom it notifies."""

from __future__ import annotations

import logging
from typing import Literal
from urllib.parse import urlsplit

from pydantic import Field, field_validator

from acquire.config.base import FrozenModel


class ServiceConfig(FrozenModel):
    """What the daemon does on its own once it has started, as after a crash or a power failure."""

    begin: Literal["idle", "armed", "recording"] = Field(
        default="idle",
        description="'armed': it arms; 'recording': it arms and records until stopped, to a new recording "
        "named after rig and time; both are tried again until they succeed or a command comes",
    )
    retry_s: float = Field(default=10.0, gt=0, le=3600, description="between two tries")
    log_level: Literal["info", "warning", "error"] = Field(
        default="info", description="of the daemon's log: what matters less is not written"
    )

    @property
    def level(self) -> int:
        """As `logging` has it."""
        return logging.getLevelNamesMapping()[self.log_level.upper()]


class HooksConfig(FrozenModel):
    """Whom the daemon tells when something is wrong; one after the other, and nobody waits for them."""

    on: tuple[Literal["fault", "loss", "disk", "verdict", "trouble"], ...] = Field(
        default=("fault", "loss", "disk"),
        description="'fault': the state is faulted; 'loss': lines were lost; 'disk': it is full soon, or has "
        "room again; 'verdict': what the lines say of the light's code",
    )
    command: tuple[str, ...] = Field(
        default=(), description="program and words; the event is JSON on its standard input"
    )
    webhook: str | None = Field(default=None, description="URL that the event is posted to as JSON")
    timeout_s: float = Field(default=10.0, gt=0, le=600, description="for either; then it is given up")

    @field_validator("webhook")
    @classmethod
    def _is_http(cls, url: str | None) -> str | None:
        """The configuration goes into every recording: no place for secrets."""
        parts = urlsplit(url or "http://x")
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError("it is not a URL of http or https")
        if "@" in parts.netloc:
            raise ValueError("credentials would be written into every recording: let a command send them")
        return url
