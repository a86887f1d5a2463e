"""The optics' blur on the page in a real browser: an error without edges, a finding with them."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from live_daemon import Daemon
from test_calibrate_edges import SETTINGS, N, checkerboard, put
from test_calibrating import SEEN_MS, aiming, fits, measure

from acquire.calibrate import open_calibration

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.needs_chromium


def test_blur_is_a_button_like_the_others(browser: Browser, tmp_path: Path) -> None:
    scene = put(tmp_path, np.full((N, N), 0.6, np.float32))
    rig = (*SETTINGS, scene, f"calibration='{tmp_path}/cal.zarr'", "web.port=0")
    with contextlib.closing(Daemon(tmp_path, *rig)) as daemon:
        with aiming(browser, daemon, "viewer") as page:
            page.locator("#why-psf", has_text="logged in as a viewer").wait_for(timeout=SEEN_MS)
        with aiming(browser, daemon, "operator") as page:
            page.locator("#step-psf", has_text="Put a square or a checkerboard in").wait_for(timeout=SEEN_MS)
            assert page.locator("#begin-psf").inner_text() == "Measure blur"
            measure(page, "psf", 1024)  # the checkerboard was forgotten
            page.locator("#step-psf [role=status].bad", has_text="cannot be measured").wait_for(
                timeout=SEEN_MS
            )
            put(tmp_path, checkerboard(8.0))
            measure(page, "psf", 1024)
            page.locator("#step-psf dl", has_text="b across the transfer 1.").wait_for(timeout=SEEN_MS)
            page.locator("#step-psf [role=status]", has_text="Done.").wait_for(timeout=SEEN_MS)
            fits(page, "aim-blur")
    assert list(open_calibration(tmp_path / "cal.zarr").steps) == ["psf"]
