"""The page's process: it serves until a signal arrives, and gives precedence to the capture processes."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import signal
import socket as sockets
from typing import TYPE_CHECKING

import uvicorn

from acquire.client import Client
from acquire.daemon.connections import Connection, raise_descriptor_limit
from acquire.errors import NoDaemonError, StoreError, UsageError
from acquire.processes.rank import EARLY, stand_back
from acquire.web.app import build_page
from acquire.web.certificate import tls_context
from acquire.web.tokens import TokenFile, load_tokens

if TYPE_CHECKING:
    import ssl
    from collections.abc import Iterator
    from pathlib import Path

    from acquire.config.web import WebConfig

NICE = 10
"""The capture path takes precedence over the page, and so do other programs."""
IDLE_S = 5
"""Time between two requests on one connection."""
# The streams of open pages never end on their own: a longer wait would only delay the end.
GRACE_S = 1
# More than the open pages can hold (`page_stream.MOST_PAGES`), which leaves some for their other requests.
MOST_CONNECTIONS = 64

log = logging.getLogger("acquire.web")


def serve_page(socket: Path, directory: Path, config: WebConfig) -> None:
    """Serve the page of the daemon on ``socket`` until SIGTERM or SIGINT.

    Raises UsageError for an address, certificate or token file that cannot be used.
    """
    stand_back(NICE, EARLY)
    # It is in the background of the daemon's terminal: with `stty tostop`, its log would stop it.
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    raise_descriptor_limit()
    tokens = TokenFile(config.token_path(socket))
    context = tls_context(config)
    family = sockets.AF_INET6 if ":" in config.host else sockets.AF_INET
    with contextlib.closing(sockets.socket(family, sockets.SOCK_STREAM)) as listener:
        # Otherwise a page that is restarted would have to wait for old connections to time out.
        listener.setsockopt(sockets.SOL_SOCKET, sockets.SO_REUSEADDR, 1)
        try:
            listener.bind((config.host, config.port))
            listener.listen(128)
        except (OSError, UnicodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "no such host"
            by_port = isinstance(error, OSError) and error.errno in (errno.EADDRINUSE, errno.EACCES)
            raise UsageError(
                f"the page cannot listen on {config.host}:{config.port}: {why}",
                hint="choose another web.port (--port), or 0 for any free port"
                if by_port
                else "choose an address of this host as web.host (--host): 127.0.0.1, or 0.0.0.0 for all",
            ) from error
        log.info("the operator's page: %s (the token: acquire web --link)", address_of(config, listener))
        asyncio.run(_serve(socket, directory, tokens, config, listener, context))


async def _serve(
    socket: Path,
    directory: Path,
    tokens: TokenFile,
    config: WebConfig,
    listener: sockets.socket,
    context: ssl.SSLContext | None,
) -> None:
    page = build_page(socket, directory, tokens, names_of(config), secure=context is not None)
    settings = uvicorn.Config(
        page,
        # Its own configuration would replace the handlers of this process.
        log_config=None,
        access_log=False,
        server_header=False,
        http=BoundedConnection,
        ws="none",
        timeout_keep_alive=IDLE_S,
        timeout_graceful_shutdown=GRACE_S,
        lifespan="on",
    )
    settings.load()
    # After `load`, which would replace it: the context here has its own errors and least version.
    settings.ssl = context
    await PageServer(settings).serve(sockets=[listener])


class PageServer(uvicorn.Server):
    """Ends in order at SIGINT and SIGTERM, as documented: a success, not a death by that signal."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Handle signals as uvicorn does, but do not send them to this process again at the end."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self.handle_exit, number, None)
        yield


class BoundedConnection(Connection):
    """A connection as the daemon's, with limits on the time of requests and readers and on their number."""

    most_connections = MOST_CONNECTIONS


def names_of(config: WebConfig) -> frozenset[str]:
    """Return the host names of the page, in lower case."""
    loopback = {"localhost", "127.0.0.1", "::1"} if config.is_loopback else set()
    # No browser asks for 0.0.0.0: it uses the name of the host.
    anywhere = {sockets.gethostname().lower()} if config.host in ("0.0.0.0", "::") else set()  # noqa: S104
    return frozenset({config.host.lower(), *map(str.lower, config.names), *loopback, *anywhere})


def address_of(config: WebConfig, listener: sockets.socket | None = None) -> str:
    """Return the page's URL for a browser on this host."""
    port = config.port if listener is None else listener.getsockname()[1]
    host = config.names[0] if config.names else config.host
    host = f"[{host}]" if ":" in host else host
    return f"{'https' if config.certificate else 'http'}://{host}:{port}/"


def link(config: WebConfig, socket: Path, role: str) -> str:
    """Return the URL with a token, in the fragment after #, which browsers do not send to servers.

    Raises UsageError for a page on any free port, which only its process knows.
    """
    if not config.port:
        raise UsageError(
            "the page listens on any free port (web.port = 0), which only its log names",
            hint="web.port with a number, or the token from the file "
            f"{config.token_path(socket)} after the address in the log and '#token='",
        )
    tokens = load_tokens(config.token_path(socket))
    return f"{address_of(config)}#token={tokens.operator if role == 'operator' else tokens.viewer}"


def directory_of(socket: Path) -> Path:
    """Return the directory of the daemon's recordings. Raises NoDaemonError, and StoreError if it is away."""
    from pathlib import Path as Directory

    status = Client(socket).status()
    disk = status.disk
    if status.disk_trouble is not None:
        raise StoreError(status.disk_trouble, hint="again once that is done")
    if disk is None:
        raise NoDaemonError("the daemon has not checked its disk yet", hint="again in a moment")
    return Directory(disk.directory)
