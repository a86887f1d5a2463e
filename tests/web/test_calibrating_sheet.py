"""The sheet on the page in a real browser: with a ticked box, its black parts show the lens's veil, too."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from live_daemon import Daemon
from test_calibrate_edges import SETTINGS, N, S, put
from test_calibrating import SEEN_MS, aiming, fits, measure

from acquire.calibrate import open_calibration
from acquire.calibrate.sheet import Sheet

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.needs_chromium


def test_a_box_says_that_the_target_s_dark_parts_are_black(browser: Browser, tmp_path: Path) -> None:
    scene = put(tmp_path, np.full((N, N), 0.6, np.float32))
    rig = (*SETTINGS, scene, f"calibration='{tmp_path}/cal.zarr'", "web.port=0")
    with contextlib.closing(Daemon(tmp_path, *rig)) as daemon, aiming(browser, daemon, "operator") as page:
        page.locator("#step-target label", has_text="send no light at all").wait_for(timeout=SEEN_MS)
        # no other step has a scene of which this could be said
        assert page.locator("#steps input[type=checkbox]").count() == 1
        measure(page, "dark", 1024)
        page.locator("#step-dark [role=status]", has_text="Done.").wait_for(timeout=SEEN_MS)

        put(tmp_path, Sheet(S).picture(N, (-5.0, 8.0), 1.5))
        page.focus("#black-target")
        page.keyboard.press("Space")
        fits(page, "aim-sheet")
        measure(page, "target", 1024)
        page.locator("#step-target [role=status]", has_text="Done.").wait_for(timeout=SEEN_MS)
        # what the recording shows besides stands with the step that measures it alone
        for step in ("psf", "veil"):
            page.locator(f"#step-{step} h3", has_text="✓").wait_for(timeout=SEEN_MS)
        assert page.locator("#black-target").is_checked()
        fits(page, "aim-veil")
    known = open_calibration(tmp_path / "cal.zarr")
    assert list(known.steps) == ["dark", "orientation", "align", "psf", "veil"]
    veil = known.quantities["veil"]
    assert (np.abs(veil.value - 0.02) < 4 * veil.uncertainty).all()
