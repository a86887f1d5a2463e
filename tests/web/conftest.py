"""A browser, if one is installed: Debian's headless chromium, driven by playwright."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from shutil import which
from typing import TYPE_CHECKING

import pytest

sys.path[:0] = [
    str(Path(__file__).parents[1] / name) for name in ("daemon", "service", "evaluate", "store")
]  # their fake and real daemons, the demo's result, and recordings

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        flags = ["--no-sandbox"] if os.geteuid() == 0 else []  # chromium refuses to sandbox itself as root
        started = playwright.chromium.launch(
            executable_path=which("chromium"), args=[*flags, "--disable-gpu", "--disable-dev-shm-usage"]
        )
        yield started
        started.close()
