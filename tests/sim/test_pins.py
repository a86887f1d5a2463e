"""The page of the gateware's pins, read while it is being written."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

import acquire.sim.clock as clock_module
from acquire.errors import DeviceError
from acquire.sim.pins import PinPage, PinRun

RUN = PinRun(1, running=True, pulses=(3, 3), line_clocks=30)


def half_written() -> PinPage:
    """A page whose writer was interrupted after it had begun."""
    page = PinPage()
    page.publish(RUN, b"\x01\x00", 100_000_000)
    page._header[0] += np.uint64(1)
    return page


def test_a_writer_that_a_busy_host_holds_up_is_waited_for() -> None:
    """It was said to have died after a second, for which real-time readers had kept it from running."""
    page = half_written()
    end = threading.Timer(1.3, lambda: page._header.__setitem__(0, page._header[0] + np.uint64(1)))
    end.start()
    began, used = time.monotonic(), time.thread_time()
    assert page.latest_run == 1
    assert time.monotonic() - began > 1
    # a reader that pauses leaves the core to the writer
    assert time.thread_time() - used < 0.5
    end.join()
    page.close()


def test_a_writer_that_died_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock_module, "_TORN_S", 0.02)
    page = half_written()
    with pytest.raises(DeviceError, match="died while it was publishing"):
        page.read()
    page.close()
