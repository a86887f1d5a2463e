"""Findings that are forgotten on the page in a real browser, with those that depend on them."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from live_daemon import Daemon
from page_server import address_in
from test_calibrate_all import scene_before, target
from test_calibrating import SEEN_MS, aiming, fits, measure
from waiting import until

from acquire.calibrate import open_calibration

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.needs_chromium


def forget(page: Page, step: str, name: str, answer: str) -> None:
    """By key alone."""
    page.locator(f"#step-{step} button:enabled", has_text=f"Forget {name}…").press("Enter")
    page.locator("#forget button", has_text=answer).press("Enter")
    page.locator("#forget").wait_for(state="hidden", timeout=SEEN_MS)


def test_a_finding_is_forgotten_with_what_depends_on_it_after_a_question(
    browser: Browser, tmp_path: Path
) -> None:
    put, settings = scene_before(tmp_path)
    cal = tmp_path / "cal.zarr"
    with contextlib.closing(Daemon(tmp_path, *settings, "web.port=0")) as daemon:
        with aiming(browser, daemon, "operator") as page:
            measure(page, "dark", 384)
            page.locator("#step-dark button:enabled", has_text="Forget dark…").wait_for(timeout=SEEN_MS)
            measure(page, "flat", 384)
            page.locator("#step-flat [role=status]", has_text="Done.").wait_for(timeout=SEEN_MS)
            put(target())
            measure(page, "target", 1024)
            page.locator("#step-target [role=status]", has_text="Done.").wait_for(timeout=SEEN_MS)
            assert set(open_calibration(cal).steps) == {"dark", "flat", "transfer", "orientation", "align"}

            forget(page, "flat", "transfer", "Forget")
            until(lambda: "transfer" not in open_calibration(cal).steps)
            page.locator("#step-flat", has_text="DN per electron").wait_for(state="hidden", timeout=SEEN_MS)
            assert page.evaluate("document.activeElement.id") == "begin-flat"

            forget(page, "dark", "dark", "Keep")
            assert "dark" in open_calibration(cal).steps
            page.locator("#step-dark button", has_text="Forget dark…").click()
            assert "dark, flat" in page.locator("#forget-title").inner_text()
            why = page.locator("#forget-why").inner_text()
            assert "flat was measured with the offsets of dark" in why
            fits(page, "aim-forget")
            page.keyboard.press("Escape")
            forget(page, "dark", "dark", "Forget")
            page.locator("#step-dark h3", has_text="not done yet").wait_for(timeout=SEEN_MS)
            assert not {"dark", "flat"} & set(open_calibration(cal).steps)
            assert page.locator("#step-dark [role=status]").inner_text() == ""
            page.locator("#why-flat", has_text="The step Dark must be done first").wait_for(timeout=SEEN_MS)

            # What is left cannot be forgotten: a calibration has a step.
            forget(page, "target", "orientation", "Forget")
            page.locator("#error", has_text="nothing would be left of").wait_for(timeout=SEEN_MS)
            assert "orientation" in open_calibration(cal).steps
            page.reload()
            page.locator("#step-target", has_text="turn 90").wait_for(timeout=SEEN_MS)
            assert page.locator("#step-dark h3", has_text="not done yet").count() == 1
        until(lambda: f"forgotten from {cal} by operator at 127.0.0.1" in daemon.log.read_text())
        with aiming(browser, daemon, "viewer") as page:
            page.locator("#step-target button:disabled", has_text="Forget").first.wait_for(timeout=SEEN_MS)
            answer = page.request.post(
                f"{address_in(daemon.log)}api/calibration/forget", data=json.dumps({"steps": ["orientation"]})
            )
            assert answer.status == 403
