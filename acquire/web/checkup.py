"""The examination of the host on request: ``acquire doctor`` in a process of its own, at the lowest priority.

Only one at a time, for a limited time. Its findings are kept, so that a viewer can read them, too.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import signal
import sys
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from acquire.daemon.who import WHO
from acquire.errors import AcquireError, BusyError, DeviceError, StateError
from acquire.web.job_words import progress_facts
from acquire.web.messages import CheckupFacts, CheckupFinding
from acquire.web.worker import OWNER

if TYPE_CHECKING:
    from pathlib import Path

WORDS = ("-m", "acquire.web.worker", "doctor", "--running", "--json")
LIMIT_S = 60.0
"""A disk that does not answer would hold it up for ever."""
KILLED_S = 2.0
"""Time for a killed process to end, which one that waits for a broken disk may not do."""

log = logging.getLogger("acquire.web")


class Checkup:
    """Belongs to one event loop."""

    def __init__(self, socket: Path) -> None:
        self._socket = socket
        self._running = False
        self._latest = CheckupFacts()

    @property
    def facts(self) -> CheckupFacts:
        """The latest findings, and whether there will soon be others."""
        return self._latest.model_copy(update={"running": self._running})

    async def examine(self) -> CheckupFacts:
        """Examine the host and return the findings.

        Raises StateError while an examination is running, BusyError if it takes too long.
        """
        if self._running:
            raise StateError("the host is being examined already", hint="wait for the findings")
        self._running = True
        log.info("the host is examined for %s", WHO.get() or "a client")
        try:
            output = await self._output()
            findings = [CheckupFinding.model_validate(one) for one in json.loads(output)]
            self._latest = CheckupFacts(examined=datetime.now(UTC), findings=findings)
        finally:
            self._running = False
        return self.facts

    async def _output(self) -> bytes:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            *WORDS,
            env=os.environ | {"ACQUIRE_SOCKET": str(self._socket), OWNER: str(os.getpid())},
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            process_group=0,
        )
        try:
            async with asyncio.timeout(LIMIT_S):
                output, errors = await process.communicate()
        except TimeoutError:
            raise BusyError(
                f"the examination was ended: it took longer than {LIMIT_S:g} s",
                hint="again when the host is less busy; acquire doctor in a terminal",
            ) from None
        finally:
            await _kill(process)
        # With the former, all has been examined, and something is bad.
        if process.returncode not in (DeviceError.exit_code, 0):
            lines = errors.decode(errors="replace").strip().splitlines() or ["it said nothing"]
            why = progress_facts(lines[-1]).get("text", "")
            raise AcquireError(f"the host could not be examined: {why}", hint="acquire doctor in a terminal")
        return output


async def _kill(process: asyncio.subprocess.Process) -> None:
    """Kill a process with its children, unless it has ended."""
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(KILLED_S):
                await process.wait()
