"""On a machine that cannot compile the gateware, the reason is reported before anything is tried."""

from __future__ import annotations

from pathlib import Path

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


def test_an_installed_package_says_where_the_gateware_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(acquire.sim.rtl, "ROOT", tmp_path)
    with pytest.raises(UsageError, match="this host lacks its sources: they are in a checkout") as refused:
        acquire.sim.rtl.demand()
    assert "pip download --no-deps" in refused.value.hint
