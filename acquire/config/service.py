"""Models of a rig's ``[service]`` and ``[hooks]``: what the daemon does on its own, and its notifications."""

from __future__ import annotations

import logging
from typing import Literal
from urllib.parse import urlsplit

from pydantic import Field, SerializationInfo, field_serializer, field_validator

from acquire.config.base import FrozenModel

WHOLE = {"whole": True}
"""Context of `RigConfig.model_dump` for a configuration with its secrets, which only its owner may see."""


class ServiceConfig(FrozenModel):
    """What the daemon does on its own after it has started, for example after a crash or a power failure."""

    begin: Literal["idle", "armed", "recording"] = Field(
        default="idle",
        description="'armed': it arms; 'recording': it arms and records until stopped, to a new recording "
        "named after rig and time; both are retried until they succeed or a command comes",
    )
    retry_s: float = Field(default=10.0, gt=0, le=3600, description="time between two attempts")
    log_level: Literal["info", "warning", "error"] = Field(
        default="info", description="lowest level of entries in the daemon's log"
    )

    @property
    def level(self) -> int:
        """The log level as a number of `logging`."""
        return logging.getLevelNamesMapping()[self.log_level.upper()]


class HooksConfig(FrozenModel):
    """Notifications of the daemon when something is wrong, sent one at a time and in the background."""

    on: tuple[Literal["fault", "loss", "disk", "verdict", "trouble"], ...] = Field(
        default=("fault", "loss", "disk"),
        description="'fault': the state is faulted; 'loss': lines were lost; 'disk': it is nearly full, "
        "has room again, or held lines exceed their limit; 'verdict': the result of checking the light's "
        "code in the lines",
    )
    command: tuple[str, ...] = Field(
        default=(), description="program and arguments; the event is JSON on its standard input"
    )
    webhook: str | None = Field(
        default=None,
        description="URL to which the event is posted as JSON; recordings, logs and pages name its host only",
        # What errors do not quote (`acquire.config.findings`).
        json_schema_extra={"writeOnly": True},
    )
    timeout_s: float = Field(
        default=10.0, gt=0, le=600, description="time after which command or webhook is abandoned"
    )

    @field_validator("webhook")
    @classmethod
    def _is_http(cls, url: str | None) -> str | None:
        """Refuse secrets, because the configuration is stored in every recording."""
        # A recording's rig has null for a webhook that was not given: it passes like any valid URL.
        given = url or "http://x"
        if any(letter <= " " or letter == "\x7f" for letter in given):
            raise ValueError("it has a space or a control character")
        try:
            parts = urlsplit(given)
            _ = parts.port  # as if it were asked for later; the error would quote it
        except ValueError:
            raise ValueError("it is not a URL: its host or port is invalid") from None
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError("it is not an http or https URL")
        if "@" in parts.netloc:
            raise ValueError("credentials would be stored in every recording; use a command to send them")
        return url

    @field_serializer("webhook", when_used="json")
    def _without_secret(self, url: str | None, info: SerializationInfo) -> str | None:
        """Leave out all but the host: the path of a chat's webhook is what allows to write there."""
        return url if url is None or info.context == WHOLE else public_url(url)


def public_url(url: str) -> str:
    """Return a URL for recordings, logs and pages, without what comes after its host."""
    parts = urlsplit(url)
    host = f"{parts.scheme}://{parts.netloc}"
    return url if url.removeprefix(host) in ("", "/") else f"{host}/…"
