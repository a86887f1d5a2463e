"""The API of a service in a thread of its own, as the daemon serves it."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

from acquire.daemon.connections import ApiServer
from acquire.daemon.control import build_app
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.local import Local
from acquire.daemon.service import Service


@contextlib.contextmanager
def api(service: Service, endpoint: Endpoint) -> Iterator[None]:
    """The API in a thread of its own, as the daemon serves it."""
    with ThreadPoolExecutor(1) as devices:

        async def run(work: Callable[[], None]) -> None:
            await asyncio.get_running_loop().run_in_executor(devices, work)

        server = ApiServer(build_app(Local(service, run)), endpoint.socket)
        thread = threading.Thread(target=asyncio.run, args=(server.answer(),))
        thread.start()
        try:
            yield
        finally:
            service.news.close()
            server.should_exit = True
            thread.join(300)
    assert not thread.is_alive()
