"""What the page shows, in a browser, of recordings and videos of which parts are gone."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fake_run import FakeRun, rig_config
from page_server import PageServer
from served import api
from store_helpers import fill, make_spec

from acquire.daemon.endpoint import Endpoint
from acquire.daemon.service import Service
from acquire.store import RecordingWriter, RunCondition, open_video, recover, write_video

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.needs_chromium


def write_both(place: Path) -> int:
    """A recovered recording without the texts of its events; a video without its first file of frames.

    Return how many frames it holds.
    """
    path = place / "r.zarr"
    with RecordingWriter.create(path, make_spec()) as writer:
        fill(writer, 150)
        writer.add_event("mark", 5, 1005, "the valve opens")
        writer.seal(RunCondition.GOOD, "done", {})
    (path / "events" / "text" / "c" / "0").unlink()
    recover(path)
    video = np.random.default_rng(1).random((60, 300, 300), np.float32)
    write_video(place / "v.zarr", video, np.arange(60), pixel_size=1.0, frame_interval_ns=1.0, provenance={})
    size = int(open_video(place / "v.zarr").video.chunks[0])
    (place / "v.zarr" / "0" / "c" / "0" / "0" / "0").unlink()
    return size


def test_what_is_gone_is_named_and_the_rest_is_shown(browser: Browser, tmp_path: Path) -> None:
    """Of the recording only an event told it, and the video was refused as a whole."""
    size = write_both(tmp_path)
    service, socket = Service(rig_config(tmp_path), lambda _: FakeRun()), tmp_path / "c.sock"
    with (
        contextlib.closing(Endpoint(socket)) as endpoint,
        api(service, endpoint),
        contextlib.closing(PageServer(socket, tmp_path)) as server,
    ):
        page = browser.new_page()
        page.goto(server.link)
        page.keyboard.press("3")
        page.locator("#recording-list small.bad", has_text="its lists are incomplete").wait_for()
        page.locator("#recording-list button").click()
        page.locator("#detail dd", has_text="have been incomplete since a recovery").wait_for()
        page.locator("#videos button", has_text="v.zarr").click()
        page.locator("#player .warning", has_text=f"frames 1 to {size} cannot be shown").wait_for()
        page.locator("#frame-text", has_text="it cannot be read, and is shown black").wait_for()
        # Of frames this large an answer holds fewer than 64: the last ones were black.
        page.keyboard.press("ArrowLeft")
        page.locator("#frame-text", has_text="Frame 60 of 60").wait_for()
        assert "cannot be read" not in page.locator("#frame-text").inner_text()
        brightest = page.evaluate(
            """() => { const picture = document.querySelector("#player canvas").getContext("2d");
            return Math.max(...picture.getImageData(0, 0, 99, 8).data.filter((_, i) => i % 4 === 0)); }"""
        )
        assert brightest > 200
        page.close()
