"""Tests that need a C compiler are left out where there is none, and the summary says so."""

from __future__ import annotations

from typing import Any

import pytest

from acquire.sim.gentl.build import compiler

_left_out: list[str] = []


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "needs_compiler: builds the simulated GenTL producer")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if compiler() is not None:
        return
    out = [item for item in items if item.get_closest_marker("needs_compiler")]
    _left_out.extend(item.nodeid for item in out)
    config.hook.pytest_deselected(items=out)
    items[:] = [item for item in items if item not in out]


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if _left_out:
        terminalreporter.write_line(f"left out, for want of a C compiler: {len(_left_out)} tests of cameras")
