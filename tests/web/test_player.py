"""The player of a report's page, in a browser: it plays unless motion is unwanted, stops and steps."""

from __future__ import annotations

import json
from base64 import b64encode
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from PIL import Image

import acquire.evaluate

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SCRIPT = Path(acquire.evaluate.__path__[0]) / "templates" / "player.js"
FRAMES = 7

pytestmark = pytest.mark.needs_chromium


def _frame(level: int) -> str:
    file = BytesIO()
    Image.new("RGB", (16, 9), (level, level, level)).save(file, "WEBP")
    return f"data:image/webp;base64,{b64encode(file.getvalue()).decode('ascii')}"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> str:
    frames = [_frame(30 * number) for number in range(FRAMES)]
    page = tmp_path_factory.mktemp("player") / "page.html"
    page.write_text(
        f"""<!DOCTYPE html><title>player</title><figure class="player" data-interval-ms="20">
        <img src="{frames[0]}" alt=""><div class="controls" hidden>
        <button>First</button><button>back</button><button>Play</button><button>on</button>
        <input type="range" min="0" max="0" value="0"></div>
        <script type="application/json">{json.dumps(frames)}</script></figure>
        <script>{SCRIPT.read_text(encoding="utf-8")}</script>"""
    )
    return page.as_uri()


def _at(page: Page) -> int:
    """The frame that is shown, by the picture itself."""
    shown = "() => document.querySelector('img').src"
    return [_frame(30 * number) for number in range(FRAMES)].index(page.evaluate(shown))


def test_it_plays_pauses_and_steps(browser: Browser, place: str) -> None:
    page = browser.new_page()
    page.goto(place)
    page.wait_for_function("() => Number(document.querySelector('input').value) > 2")
    page.get_by_role("button", name="Pause").click()
    page.locator("input").focus()
    page.keyboard.press("End")
    assert _at(page) == FRAMES - 1
    page.keyboard.press("ArrowRight")
    assert _at(page) == 0
    page.get_by_role("button", name="back").click()
    assert (_at(page), page.locator("input").input_value()) == (FRAMES - 1, str(FRAMES - 1))
    page.close()


def test_it_stands_where_motion_is_unwanted(browser: Browser, place: str) -> None:
    page = browser.new_page(reduced_motion="reduce")
    page.goto(place)
    page.get_by_role("button", name="Play").wait_for()
    page.wait_for_timeout(200)
    assert _at(page) == 0
    page.keyboard.press("Tab")
    page.get_by_role("button", name="on").click()
    assert _at(page) == 1
    page.close()
