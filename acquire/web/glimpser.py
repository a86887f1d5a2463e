"""Owns the process that makes glimpses, while a page shows them, and keeps only the latest glimpse."""

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
"""Pause before the process is started again if it has ended on its own."""
MOST_BYTES = 2**22
"""Largest glimpse."""

log = logging.getLogger("acquire.web")


class Glimpser:
    """Belongs to one event loop, in which `run` must run."""

    def __init__(self, socket: Path, wake: Callable[[], None]) -> None:
        self._socket = socket
        self._wake = wake
        self._watchers = 0
        self._changed = asyncio.Event()
        self.latest = b""
        self.number = 0
        """Number of the latest glimpse; 0 if there is none."""

    def watch(self) -> None:
        self._watchers += 1
        self._changed.set()

    def leave(self) -> None:
        self._watchers -= 1
        self._changed.set()

    async def run(self) -> None:
        """Run the process while there are watchers, until cancelled."""
        while True:
            while not self._watchers:
                self._changed.clear()
                await self._changed.wait()
            try:
                await self._run_process()
            # No process, or no thread for it, can be started now: the host is out of memory or numbers.
            except (OSError, RuntimeError) as error:
                log.warning("no glimpses: their process cannot be started: %s", error)
            if self._watchers:
                await asyncio.sleep(AGAIN_S)

    async def _run_process(self) -> None:
        """Run the process once, until there are no watchers or it ends on its own."""
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
                # Nothing is awaited between the count of the watchers and this, so that no change is missed.
                self._changed.clear()
                changed = asyncio.create_task(self._changed.wait())
                await asyncio.wait((changed, reading), return_when=asyncio.FIRST_COMPLETED)
                changed.cancel()
        finally:
            # By force: it holds nothing that could be left unfinished, and may be in the middle of a solve.
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
                if size > MOST_BYTES:  # the stream is out of step: the process is restarted
                    return
                self.latest = head + await process.stdout.readexactly(size)
                self.number += 1
                self._wake()
        except (asyncio.IncompleteReadError, struct.error):
            log.warning("the process that makes glimpses has ended")
