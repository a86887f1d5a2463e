"""The instrument from a script: arm it, record, follow events, cut and reconstruct.

::

    from acquire.client import SEALED, Client

    with Client() as client:                       # the default socket; a path; or http://HOST:PORT, token=…
        client.arm()
        client.start("run.zarr", pre_s=0.2, post_s=1.0)
        client.mark("the valve opens")
        client.wait(SEALED, timeout_s=60)
        for news in client.events(history=True, timeout_s=0):
            print(news.time, news.text)
        segment = client.open("run.zarr").cut(first_line, lines=263)

`Client` (`blocking`) and `AsyncClient` (`asynchronous`) have the same methods, with `await` in the latter;
`core` is what they share, without input or output. Both use the API that the daemon describes at
/openapi.json and `acquire web` at /api/openapi.json.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.client.blocking import Client
from acquire.client.core import EventReader
from acquire.daemon.facts import Health, News, Setup
from acquire.daemon.messages import Status
from acquire.daemon.states import SEALED, State
from acquire.lazy import lazily

if TYPE_CHECKING:
    from acquire.client.asynchronous import AsyncClient

__all__ = ["SEALED", "AsyncClient", "Client", "EventReader", "Health", "News", "Setup", "State", "Status"]

# Lazy, so that the command line, which makes one call and exits, does not import asyncio.
if not TYPE_CHECKING:  # a type checker would accept any name
    __getattr__, __dir__ = lazily(__name__, {"AsyncClient": "asynchronous"}, __all__)
