"""Model of a rig's ``[web]``: the operator's page."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from acquire.config.base import FilePath, FrozenModel


class WebConfig(FrozenModel):
    """The operator's page, in a process of its own; who may enter it is told by a token."""

    host: str = Field(
        default="127.0.0.1", description="address to listen on; another than loopback needs a certificate"
    )
    port: int = Field(default=8300, ge=0, le=65535, description="0: any that is free; the log names it")
    names: tuple[str, ...] = Field(
        default=(), description="names by which browsers may ask for the page, besides the host's address"
    )
    certificate: FilePath | None = Field(default=None, description="PEM file, for https; with `key`")
    key: FilePath | None = Field(default=None, description="PEM file of the certificate's private key")
    token_file: FilePath | None = Field(
        default=None, description="where the tokens are kept; absent: beside the control socket"
    )
    plain: bool = Field(
        default=False,
        description="another address than loopback without a certificate: token and pictures can be read by "
        "whoever is on the way",
    )

    @model_validator(mode="after")
    def _closed_to_strangers(self) -> WebConfig:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together")
        if not self.is_loopback and self.certificate is None and not self.plain:
            raise ValueError(
                f"host {self.host} can be reached from elsewhere; possible: 127.0.0.1 (and ssh -L), a "
                "certificate and key, or plain = true"
            )
        return self

    @property
    def is_loopback(self) -> bool:
        return self.host in ("127.0.0.1", "::1", "localhost")

    def token_path(self, socket: Path) -> Path:
        return self.token_file or socket.with_name(socket.name + ".tokens")
