"""Tests of the compiled gateware need a compiler; without one they are left out, and the run says so."""

from __future__ import annotations

from typing import Any

from firmware.cxxrtl import missing

collect_ignore = ["rtl"] if missing() else []


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if reason := missing():
        terminalreporter.write_line(f"tests/firmware/rtl was left out: there is no {reason}", yellow=True)
