"""A daemon stays reachable: a control socket whose name was removed is made again.

Programs that tidy up /tmp, and the end of a user's last session, which empties XDG_RUNTIME_DIR, remove
sockets and locks of daemons that run on.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acquire.daemon.connections import ApiServer
    from acquire.daemon.endpoint import Endpoint
    from acquire.daemon.news import NewsLog
    from acquire.daemon.troubles import Troubles

LOOK_EVERY_S = 1.0

log = logging.getLogger("acquire.daemon")


async def stay_reachable(endpoint: Endpoint, server: ApiServer, news: NewsLog, troubles: Troubles) -> None:
    """Look for the names of socket and lock, and make them again, until this is cancelled."""
    known = ""
    while True:
        await asyncio.sleep(LOOK_EVERY_S)
        try:
            # In a thread: the directory may be on a disk that does not answer.
            listener = await asyncio.to_thread(endpoint.renewed)
            if listener is not None:
                await server.move(listener)
                text = f"the control socket {endpoint.path} was removed by another program, and is made again"
                log.warning("%s", text)
                news.add("trouble", text, level="warning")
        except Exception as error:  # noqa: BLE001 - shown in the status; tried again
            if str(error) != known:  # not once a second
                troubles.note("control socket", error)
            known = str(error)
        else:
            known = ""
