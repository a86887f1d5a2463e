"""Calibration on the page in a real browser: dark, flat, target, and a cancelled sweep of delays."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from live_daemon import Daemon
from page_server import address_in
from test_calibrate_all import WHITE, scene_before, target
from waiting import until

from acquire.calibrate import open_calibration
from acquire.client import SEALED
from acquire.web.tokens import load_tokens

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.needs_chromium

SEEN_MS = 240_000
SETTLED_MS = 5_000
SCREENSHOTS = os.environ.get("ACQUIRE_SCREENSHOTS")


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[tuple[Daemon, Callable[[str], None]]]:
    """A daemon with a page, and what puts a scene before its cameras."""
    put, settings = scene_before(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as free:  # the page that is started anew has the same address
        port = free.getsockname()[1]
    with contextlib.closing(Daemon(tmp_path, *settings, f"web.port={port}")) as made:
        yield made, put


@contextlib.contextmanager
def aiming(browser: Browser, daemon: Daemon, role: str) -> Iterator[Page]:
    token = getattr(load_tokens(daemon.home / "c.sock.tokens"), role)
    with contextlib.closing(browser.new_context(viewport={"width": 1280, "height": 900})) as context:
        page = context.new_page()
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(f"{address_in(daemon.log)}#token={token}")
        page.wait_for_selector("body[data-state=idle]", timeout=SEEN_MS)
        page.keyboard.press("2")
        page.wait_for_selector("#begin-dark", timeout=SEEN_MS)
        yield page
        assert problems == []


def measure(page: Page, step: str, lines: int) -> None:
    """By key alone."""
    page.wait_for_selector(f"#begin-{step}:enabled", timeout=SEEN_MS)
    page.focus(f"#lines-{step}")
    page.keyboard.press("Control+a")
    page.keyboard.type(str(lines))
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")


def fits(page: Page, name: str) -> None:
    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme)  # type: ignore[arg-type]
        for width in (400, 1024, 1280):
            page.set_viewport_size({"width": width, "height": 900})
            # A picture adapts to another width a moment later.
            fitting = "width => document.documentElement.scrollWidth <= width"
            page.wait_for_function(fitting, arg=width, timeout=SETTLED_MS)
            if SCREENSHOTS:
                page.screenshot(path=Path(SCREENSHOTS) / f"{name}-{theme}-{width}.png", full_page=True)


def test_dark_flat_target_and_a_sweep_that_is_cancelled(
    browser: Browser, bench: tuple[Daemon, Callable[[str], None]]
) -> None:
    daemon, put = bench
    cal = daemon.home / "cal.zarr"
    with aiming(browser, daemon, "viewer") as page:
        page.locator("#why-dark", has_text="logged in as a viewer").wait_for(timeout=SEEN_MS)
        assert page.locator("#steps button:enabled").count() == 0
        answer = page.request.post(f"{address_in(daemon.log)}api/calibration", data={"step": "dark"})
        assert answer.status == 403
    with aiming(browser, daemon, "operator") as page:
        page.locator("#why-flat", has_text="The step Dark must be done first").wait_for(timeout=SEEN_MS)
        fits(page, "aim-before")
        measure(page, "dark", 8)  # fewer than are any use: the browser asks for more
        assert not page.evaluate("document.getElementById('lines-dark').validity.valid")
        measure(page, "dark", 384)
        page.locator("#step-dark", has_text="in the worst column").wait_for(timeout=SEEN_MS)
        measure(page, "flat", 384)
        page.locator("#step-flat", has_text="DN per electron").wait_for(timeout=SEEN_MS)

        put(WHITE.replace("0.5 }", "0.0 }"))  # the target was forgotten
        measure(page, "target", 384)
        page.locator("#step-target [role=status].bad", has_text="Failed: ").wait_for(timeout=SEEN_MS)
        put(target())
        measure(page, "target", 1024)
        page.locator("#step-target dl", has_text="turn 90").wait_for(timeout=SEEN_MS)

        put(WHITE)
        measure(page, "delay", 1024)
        second = daemon.home / "calibration-recordings" / "delay-2.zarr"
        until(second.exists)
        page.locator("#why-dark", has_text="The step Delay is running").wait_for(timeout=SEEN_MS)
        assert page.evaluate("document.activeElement.id") == "cancel-delay"
        fits(page, "aim-sweeping")
        page.keyboard.press("Enter")
        page.locator("#step-delay [role=status]", has_text="Cancelled: ").wait_for(timeout=SEEN_MS)
        assert page.evaluate("document.activeElement.id") == "begin-delay"
        fits(page, "aim-after")

        page.wait_for_selector("body[data-state=idle]:not([data-stale])", timeout=SEEN_MS)
        with daemon.client() as client:
            client.arm()
            client.start(daemon.home / "run.zarr", lines=2**31)
            page.locator("#why-dark", has_text="is recording").wait_for(timeout=SEEN_MS)
            client.stop()
            client.wait(SEALED, timeout_s=120)
        page.wait_for_selector("#begin-dark:enabled", timeout=SEEN_MS)
    known = open_calibration(cal)
    assert {"dark", "flat", "transfer", "orientation", "align"} <= set(known.steps)
    assert known.alignment is not None
    assert known.alignment.alignment.rows == pytest.approx(1.4, abs=0.15)
    assert known.steps["dark"]["lines"] == 384
    until(lambda: "arm by operator at 127.0.0.1" in daemon.log.read_text())
