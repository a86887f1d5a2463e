"""The page's process, as the daemon starts it, for a test's own daemon."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from pathlib import Path

from acquire.web.tokens import load_tokens

END_S = 300.0


def address_in(log: Path) -> str:
    """The latest that the log names."""
    deadline = time.monotonic() + END_S
    while not (found := re.findall(r"the operator's page: (https?://\S+/)", log.read_text())):
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.02)
    return found[-1]


class PageServer:
    """``acquire web`` for a socket."""

    def __init__(self, socket: Path, directory: Path, **settings: object) -> None:
        self.log = directory / "web.log"
        given = {"socket": str(socket), "directory": str(directory), "web": {"port": 0, **settings}}
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "acquire", "web", "--owned", "--given", json.dumps(given)],
                stdin=subprocess.PIPE,
                stderr=log,
            )
        self.address = address_in(self.log)
        tokens = load_tokens(socket.with_name(socket.name + ".tokens"))
        self.operator, self.viewer = tokens.operator, tokens.viewer

    @property
    def link(self) -> str:
        return f"{self.address}#token={self.operator}"

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(END_S)
