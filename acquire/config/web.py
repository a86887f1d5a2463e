"""Model of a rig's ``[web]``: the operator's page."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, field_validator, model_validator

from acquire.config.base import FilePath, FrozenModel


class WebConfig(FrozenModel):
    """The operator's page, which runs in its own process and is protected by tokens."""

    host: str = Field(
        default="127.0.0.1", description="address to listen on; any but loopback needs a certificate"
    )
    port: int = Field(default=8300, ge=0, le=65535, description="0: any free port; the log names it")
    names: tuple[str, ...] = Field(
        default=(), description="host names by which browsers may open the page, besides the host's address"
    )
    certificate: FilePath | None = Field(default=None, description="PEM file, for https; with `key`")
    key: FilePath | None = Field(default=None, description="PEM file of the certificate's private key")
    token_file: FilePath | None = Field(
        default=None, description="file that stores the tokens; absent: next to the control socket"
    )
    plain: bool = Field(
        default=False,
        description="true: allow an address other than loopback without a certificate; token and pictures "
        "can then be read on the network",
    )

    @field_validator("host")
    @classmethod
    def _is_an_address(cls, host: str) -> str:
        # To a socket, an empty text is every address, which one should have to ask for by its name.
        if not host or host != "".join(host.split()):
            raise ValueError("it must be an address: 127.0.0.1, or 0.0.0.0 for every address of this host")
        return host

    @model_validator(mode="after")
    def _closed_to_strangers(self) -> WebConfig:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key must be given together")
        if not self.is_loopback and self.certificate is None and not self.plain:
            raise ValueError(
                f"host {self.host} can be reached from other hosts; possible: 127.0.0.1 (and ssh -L), a "
                "certificate and key, or plain = true"
            )
        return self

    @property
    def is_loopback(self) -> bool:
        """Whether only this host can reach the page."""
        return self.host in ("127.0.0.1", "::1", "localhost")

    def token_path(self, socket: Path) -> Path:
        """Return the file of the tokens; by default it is next to the daemon's socket."""
        return self.token_file or socket.with_name(socket.name + ".tokens")
