"""The operator's page, started if the rig has ``[web]``: a separate process for which nobody waits.

It ends when its standard input is closed, which happens however the daemon ends. If it ends unexpectedly it
is restarted, after growing waits.
"""

from __future__ import annotations

import contextlib
import json
import logging
import subprocess
import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.config import RigConfig
    from acquire.config.web import WebConfig

FIRST_WAIT_S, MOST_WAIT_S = 0.5, 30.0
LIVED_S = 60.0
"""A page that lived for this long is restarted with the shortest wait when it ends."""
END_S = 5.0

log = logging.getLogger("acquire.daemon")


class Page:
    """For one thread; `poll` never waits."""

    def __init__(self, socket: Path) -> None:
        """Nothing is started yet."""
        self._socket = socket
        self._words: list[str] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._begun_s = self._not_before_s = 0.0
        self._wait_s = FIRST_WAIT_S
        self._leaving: subprocess.Popen[bytes] | None = None
        self._left_s = 0.0

    def poll(self, config: RigConfig) -> None:
        """Start it according to ``config``; restart it if it has ended or ``[web]`` has changed."""
        now_s = time.monotonic()
        words = None if config.web is None else self._command(config, config.web)
        if words != self._words:
            if self._process is not None:
                self._leaving, self._left_s = self._process, now_s
                self._forget()
            self._words, self._not_before_s, self._wait_s = words, now_s, FIRST_WAIT_S
        if self._leaving is not None and self._leaving.poll() is None:  # it still has the address
            if now_s - self._left_s > END_S:
                self._leaving.kill()
            return
        self._leaving = None
        if self._words is None or now_s < self._not_before_s:
            return
        if self._process is not None:
            code = self._process.poll()
            if code is None:
                return
            log.warning("the operator's page has ended (%s); it is restarted", code)
            self._forget()
            self._wait_s = (
                FIRST_WAIT_S if now_s - self._begun_s > LIVED_S else min(MOST_WAIT_S, 2 * self._wait_s)
            )
            self._not_before_s = now_s + self._wait_s
            return
        self._begun_s = now_s
        try:
            # In a process group of its own: Ctrl-C on the terminal ends the daemon, which then ends the page.
            # Not in a session of its own: a kernel with autogroups shares the processors among sessions
            # first, and the page would get half of them, however nice it is.
            self._process = subprocess.Popen(  # noqa: S603 - this package
                self._words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, process_group=0
            )
        except OSError as error:
            log.error("the operator's page cannot be started: %s", error)  # noqa: TRY400 - no traceback
            self._not_before_s = now_s + MOST_WAIT_S

    def _command(self, config: RigConfig, web: WebConfig) -> list[str]:
        """Return the command line that starts it."""
        given = {
            "socket": str(self._socket),
            "directory": str(config.recording.directory.absolute()),
            "web": web.model_dump(mode="json"),
        }
        # As words, and not by the rig file, of which the daemon may have overridden values (--set).
        return [sys.executable, "-m", "acquire", "web", "--owned", "--given", json.dumps(given)]

    @property
    def pid(self) -> int | None:
        return None if self._process is None else self._process.pid

    def close(self) -> None:
        """End it by closing its standard input, then by force. Idempotent."""
        processes = [one for one in (self._process, self._leaving) if one is not None]
        self._forget()
        self._leaving = None
        for process in processes:
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _forget(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        self._process = None
