"""Owns the process that makes glimpses, while somebody looks at them; keeps the latest one, and no more."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import struct
import sys
from typing import TYPE_CHECKING

from acquire.web.frames import HEAD

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

AGAIN_S = 5.0
"""After it has ended by itself."""
MOST_BYTES = 2**22
"""Of one glimpse."""

log = logging.getLogger("acquire.web")


class Glimpser:
    """For one event loop; `run` is its life."""

    def __init__(self, socket: Path, wake: Callable[[], None]) -> None:
        self._socket = socket
        self._wake = wake
        self._watchers = 0
        self._changed = asyncio.Event()
        self.latest = b""
        self.number = 0
        """Of the latest; 0: there is none."""

    def watch(self) -> None:
        self._watchers += 1
        self._changed.set()

    def leave(self) -> None:
        self._watchers -= 1
        self._changed.set()

    async def run(self) -> None:
        """Have glimpses made while somebody watches, until cancelled."""
        while True:
            while not self._watchers:
                self._changed.clear()
                await self._changed.wait()
            await self._follow()
            if self._watchers:
                await asyncio.sleep(AGAIN_S)

    async def _follow(self) -> None:
        """One life of the process: it ends when nobody watches any more, or by itself."""
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "acquire.web.glimpse",
            str(self._socket),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )
        reading = asyncio.create_task(self._read(process))
        try:
            while self._watchers and not reading.done():
                self._changed.clear()
                changed = asyncio.create_task(self._changed.wait())
                await asyncio.wait((changed, reading), return_when=asyncio.FIRST_COMPLETED)
                changed.cancel()
        finally:
            reading.cancel()
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    async def _read(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None
        try:
            while True:
                head = await process.stdout.readexactly(HEAD.size)
                size = sum(HEAD.unpack(head))
                if size > MOST_BYTES:  # no message of ours: the stream is out of step, and another begins
                    return
                self.latest = head + await process.stdout.readexactly(size)
                self.number += 1
                self._wake()
        except (asyncio.IncompleteReadError, struct.error):
            log.warning("the process that makes glimpses has ended")
