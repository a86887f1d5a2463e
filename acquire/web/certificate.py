"""The page's certificate, for https: checked with a rig file, too, where the page's server may be absent."""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING

from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.config.web import WebConfig


def tls_context(config: WebConfig) -> ssl.SSLContext | None:
    """Return the context with certificate and key, or None if there is none. Raises UsageError."""
    if config.certificate is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2  # earlier versions are deprecated (RFC 8996)
    try:
        context.load_cert_chain(config.certificate, config.key)
    except OSError as error:  # ssl.SSLError is one
        raise UsageError(
            f"web.certificate {config.certificate} and web.key {config.key} cannot be used: {error.strerror}",
            possible="PEM files that belong together, readable by this user",
            hint="the permissions of both files, and `openssl x509 -in FILE -noout -subject`",
        ) from error
    return context
