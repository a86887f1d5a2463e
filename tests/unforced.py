"""In rooms that prove nothing about power cuts, this process does not force its files to the medium.

Sealing a recording forces 190 files and directories. That is two thirds of the time of a test that records
256 lines, and far more while other tests use the same disk. What is read back is the same without it: only a
power cut could tell, which `tests/store` simulates. Processes that a test starts force theirs.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path

import pytest

NAMES = ("calibrate", "cli", "evaluate", "exchange", "numerics", "recon", "reconstruct", "sim", "web")
ROOMS = {Path(__file__).parent / name for name in NAMES}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Around the fixtures as well, which make most of the recordings."""
    if ROOMS.isdisjoint(item.path.parents):
        return (yield)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("fsync", "fdatasync"):
            patch.setattr(os, name, os.fstat)  # which refuses a descriptor that is closed, too
        return (yield)
