"""Notifications by the daemon: a command or a webhook, at a fault, lost lines, or a disk that fills.

A separate thread sends them one after the other. It follows the news like any client: a slow or hanging hook
is given up after a timeout, and later news are sent afterwards, as far as the log still has them.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

from acquire.config.service import public_url
from acquire.daemon.states import State
from acquire.processes.rank import hold_back

if TYPE_CHECKING:
    from acquire.config.service import HooksConfig
    from acquire.daemon.news import NewsLog

END_S = 2.0
MOST_AT_ONCE = 20
"""Number of news that are sent one by one; of more only the latest."""
_NICE = 10
START_S = 10.0
"""Time in which `acquire.daemon.post` starts, which has a limit of its own from then on."""

log = logging.getLogger("acquire.daemon")


class Hooks:
    """Sends news to the configured hooks; no thread is started if there are none."""

    def __init__(self, config: HooksConfig, news: NewsLog, rig: str) -> None:
        self._news, self._rig = news, rig
        self._last_id = news.last_id
        self._happened = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="hooks", daemon=True)
        self.reconfigure(config)

    def reconfigure(self, config: HooksConfig) -> None:
        """Use the hooks of ``config`` from now on."""
        self._config = config
        if (config.command or config.webhook) and not self._thread.is_alive():
            # What happened while there was no hook is not sent.
            self._last_id = self._news.last_id
            self._news.listen(self._happened.set)
            self._thread.start()

    def close(self) -> None:
        """Send the remaining news, for `END_S` at most. Idempotent."""
        # In this order: if it were woken first, it could look for its end too early, and wait for ever.
        self._ended = True
        self._happened.set()
        self._news.forget(self._happened.set)
        if self._thread.is_alive():
            self._thread.join(END_S)

    def _run(self) -> None:
        while True:
            self._happened.wait()
            # Before the look, so that news that come while hooks are at work wake it again.
            self._happened.clear()
            found = self._news.after(self._last_id)
            self._last_id = found[-1].id if found else self._last_id
            wanted = []
            for news in found:
                # A change of state with the level of an error is how the log tells a fault.
                fault = news.kind == "state" and news.state is State.FAULTED and news.level == "error"
                if ("fault" if fault else news.kind) in self._config.on:
                    wanted.append(news)
            # A hook may take its whole timeout, and a burst has hundreds of news: it would be late by hours.
            for news in wanted[-MOST_AT_ONCE:]:
                # Whoever gets the messages of several rigs must see whose it is.
                named = news.model_copy(update={"text": f"{self._rig}: {news.text}"})
                text = named.model_dump_json().encode()
                limit_s = self._config.timeout_s
                if self._config.command:
                    _call(self._config.command[0], list(self._config.command), text, limit_s)
                if url := self._config.webhook:
                    words = [sys.executable, "-m", "acquire.daemon.post", f"{limit_s}"]
                    _call(public_url(url), words, b"%s\n%s" % (url.encode(), text), limit_s, posts=True)
            if self._ended:
                return


def _call(name: str, words: list[str], text: bytes, limit_s: float, *, posts: bool = False) -> None:
    """Give ``text`` to a command, or to `acquire.daemon.post`; log why that failed."""
    try:
        process = subprocess.Popen(  # noqa: S603 - the command is in the rig's configuration
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if posts else subprocess.DEVNULL,
            # Ctrl-C on the daemon's terminal is not meant for it; and it is given up with its children
            start_new_session=True,
        )
    except (OSError, ValueError) as error:  # a zero byte in a word is a ValueError
        log.warning("hook %s: %s", name, error)
        return
    hold_back(process.pid, _NICE)
    try:
        _converse(process, name, text, limit_s, posts=posts)
    finally:
        # Of one that cannot be ended, subprocess would keep them open until it ends.
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()


def _converse(
    process: subprocess.Popen[bytes], name: str, text: bytes, limit_s: float, *, posts: bool
) -> None:
    """Give ``text`` to a process, wait for its end, and log what went wrong."""
    try:
        why, _ = process.communicate(text, limit_s + START_S * posts)
    except subprocess.TimeoutExpired:
        log.warning("hook %s timed out after %g s", name, limit_s)
        try:
            os.killpg(process.pid, signal.SIGKILL)  # with its children
            process.communicate(timeout=END_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            # A command that became another user cannot be killed, and is left alone.
            log.warning("hook %s cannot be ended: %s", name, error)
        return
    if posts and process.returncode == -signal.SIGALRM:
        log.warning("hook %s timed out after %g s", name, limit_s)
    elif process.returncode and why:
        log.warning("hook %s: %s", name, why.decode(errors="replace"))
    elif process.returncode:
        log.warning("hook %s ended with exit code %d", name, process.returncode)
