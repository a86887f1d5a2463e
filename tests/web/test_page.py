"""A recording with a real daemon in a real browser, from arming to the reconstructed video."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest
from live_daemon import Daemon
from page_server import address_in

from acquire.store import open_recording, open_video
from acquire.web.tokens import load_tokens

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.needs_chromium

SEEN_MS = 120_000


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    with contextlib.closing(Daemon(tmp_path, "web.port=0")) as made:
        yield made


@pytest.fixture
def page(browser: Browser, daemon: Daemon) -> Iterator[Page]:
    with contextlib.closing(browser.new_context(viewport={"width": 1280, "height": 900})) as context:
        page = context.new_page()
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(link(daemon))
        page.wait_for_selector("#arm:enabled", timeout=SEEN_MS)
        yield page
        assert problems == []


def link(daemon: Daemon) -> str:
    address = address_in(daemon.log)
    return f"{address}#token={load_tokens(daemon.home / 'c.sock.tokens').operator}"


def page_process(daemon: Daemon) -> psutil.Process:
    (found,) = [one for one in psutil.Process(daemon.process.pid).children() if "web" in one.cmdline()]
    return found


def test_a_take_from_arming_to_the_video(page: Page, daemon: Daemon) -> None:
    page.keyboard.press("a")
    page.wait_for_selector("#record:enabled", timeout=SEEN_MS)
    page.locator(".none").first.wait_for(state="hidden", timeout=SEEN_MS)  # the first rows have been drawn
    page.locator(".arm header", has_text="level").first.wait_for(timeout=SEEN_MS)
    until_past(daemon, seconds=0.3)
    page.keyboard.press("5")
    page.locator("#setup dd", has_text="acquire simulated TDI camera").first.wait_for(timeout=SEEN_MS)
    devices = page.inner_text("#setup section[aria-label=Devices]")
    assert "sync trigger (model)\nfirmware " in devices, devices
    assert "at simulated trigger" in devices
    page.keyboard.press("4")
    page.locator("#latencies", has_text="s old").wait_for(timeout=SEEN_MS)
    page.locator("#log li", has_text="idle → armed").wait_for(timeout=SEEN_MS)
    page.click("#examine")
    page.locator("#findings tr", has_text="acquire 0.1.0 is running").wait_for(timeout=SEEN_MS)
    assert not page.get_by_role("cell", name="camera a", exact=True).count(), "no device is opened"
    page.wait_for_selector("#examine:enabled", timeout=SEEN_MS)
    page.keyboard.press("1")
    page.fill("#pre", "0.2")
    page.keyboard.press("Tab")
    page.click("#record")
    page.wait_for_selector("#stop:enabled", timeout=SEEN_MS)
    page.fill("#mark-text", "the valve <b>opens</b>")
    page.keyboard.press("Enter")
    page.locator("#events", has_text="mark: the valve <b>opens</b>").wait_for(timeout=SEEN_MS)

    page.check("#glimpse-on")
    page.locator("#glimpse-text", has_text="16 × 16 voxels").wait_for(timeout=SEEN_MS)

    victim = page_process(daemon)  # the recorder must not notice
    victim.kill()
    page.wait_for_selector("body[data-stale]", timeout=SEEN_MS)
    with daemon.client() as client:
        client.stop()

    recorded = open_recording(next(daemon.home.glob("small-*.zarr")))
    assert recorded.attrs["run_condition"] == "GOOD"
    (mark,) = [event for event in recorded.events if "valve" in event.text]
    assert "start by operator at 127.0.0.1" in [event.text for event in recorded.events]
    assert mark.line - recorded.first_line >= 0.15 * 10_000  # it begins before it was asked for

    until_restarted(daemon, victim.pid)
    page.goto(link(daemon))
    page.wait_for_selector("#disarm:enabled", timeout=SEEN_MS)
    page.keyboard.press("3")
    page.locator("#recording-list button").first.click()
    page.locator("#detail button", has_text="valve").click()
    assert page.input_value("#first-line") == str(mark.line - 128)
    page.fill("#line-count", "40")
    page.fill("#voxel-side", "2")
    page.select_option("#preset", "fast")
    for button in ("cut", "reconstruct"):
        page.click(f"#{button}")
    done = page.locator("#jobs li", has_text="done")
    done.nth(1).wait_for(timeout=SEEN_MS)
    with page.expect_download() as download:
        page.locator("#jobs a").click()
    assert Path(download.value.path()).stat().st_size > 1000
    page.locator("#videos button", has_text="2x1").click()
    page.wait_for_selector("#frame-text", timeout=SEEN_MS)
    page.keyboard.press("ArrowRight")
    page.locator("#frame-text", has_text="Frame 2 of").wait_for(timeout=SEEN_MS)
    video = open_video(next(daemon.home.glob("*-2x1.zarr")))
    assert page.locator("#frame-text", has_text=f"of {video.video.shape[0]},").is_visible()
    page.locator("body").press(" ")
    page.locator("#frame-text", has_not_text="Frame 2 of").wait_for(timeout=SEEN_MS)
    assert page.evaluate("document.querySelector('#first-line').clientWidth") > 120, "a month has 11 digits"

    page.keyboard.press("1")
    page.wait_for_selector("#arms .none", state="hidden", timeout=SEEN_MS)
    page.keyboard.press("d")
    page.locator("#arms .past .none", has_text="Not live").first.wait_for(timeout=SEEN_MS)

    os.kill(
        daemon.process.pid, signal.SIGKILL
    )  # its page goes with it; what is open says that it hears nothing
    page.wait_for_selector("body[data-stale]", timeout=SEEN_MS)
    daemon.process.wait()


def until_past(daemon: Daemon, seconds: float) -> None:
    """The rings hold so much of the past."""
    deadline = time.monotonic() + 300
    with daemon.client() as client:
        while (arm := client.status().arms["a"]).delivered < seconds * 10_000 + arm.preroll:
            assert time.monotonic() < deadline
            time.sleep(0.02)


def until_restarted(daemon: Daemon, before: int) -> None:
    deadline = time.monotonic() + 300
    log = daemon.log.read_text
    while log().count("the operator's page: http") < 2 or page_process(daemon).pid == before:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_setup_that_changes_is_shown_and_who_changed_it_among_the_events(
    page: Page, daemon: Daemon
) -> None:
    page.keyboard.press("5")
    page.locator("#setup", has_text="small").wait_for(timeout=SEEN_MS)
    assert "recording.reserve_gb" not in page.locator("#setup table").first.inner_text()
    text = daemon.config.read_text().replace("[recording]", "[recording]\nreserve_gb = 0.5")
    daemon.config.write_text(text)
    assert daemon("reload").code == 0
    page.locator("#setup table", has_text="recording.reserve_gb").first.wait_for(timeout=SEEN_MS)
    page.keyboard.press("1")
    told = "reload by the control socket: recording.reserve_gb = 0.5, it was 0.25"
    page.locator("#events", has_text=told).wait_for(timeout=SEEN_MS)
