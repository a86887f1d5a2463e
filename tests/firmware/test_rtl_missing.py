"""A machine that cannot compile the gateware is told why, before anything is tried."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import acquire.sim.rtl
import firmware.cxxrtl
from acquire.errors import UsageError
from firmware.cxxrtl import library as build_library
from firmware.top import Build


def test_without_a_compiler_the_reason_is_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert firmware.cxxrtl.missing() == "g++ (Debian, Ubuntu: apt install g++)"
    with pytest.raises(UsageError, match=r"there is no g\+\+ \(Debian"):
        build_library(Build())
    assert not (tmp_path / "cache").exists()


def test_without_yosys_the_reason_is_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "g++").touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(acquire.sim.rtl, "find_spec", lambda name: None)
    assert firmware.cxxrtl.missing() == "Amaranth (pip install 'tdi-acquire[firmware]')"


def test_the_summary_names_what_was_left_out(summary: list[str]) -> None:
    assert summary[:1] == ["tests/firmware/rtl was left out: there is no g++"]


@pytest.fixture
def summary(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What this folder's conftest says at the end of a run on a machine without a compiler."""
    here = str(Path(__file__).with_name("conftest.py"))
    plugins = request.config.pluginmanager.get_plugins()
    conftest: Any = next(plugin for plugin in plugins if getattr(plugin, "__file__", None) == here)
    said: list[str] = []

    class Reporter:
        def write_line(self, line: str, **_: Any) -> None:
            said.append(line)

    monkeypatch.setattr(conftest, "missing", lambda: "g++")
    conftest.pytest_terminal_summary(Reporter())
    return said
