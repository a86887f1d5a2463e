"""The simulated producer's compilation where the compiler does not come to an end."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from acquire.errors import DeviceError
from acquire.sim.gentl import build as module


def test_a_compiler_that_does_not_end_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    compiler = tmp_path / "slow-cc"
    compiler.write_text("#!/bin/sh\nexec sleep 30\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "COMPILE_S", 0.1)
    with pytest.raises(DeviceError, match=r"slow-cc did not compile the producer within 0\.1 s"):
        module.build()
    assert not list((tmp_path / "cache" / "tdi-acquire").iterdir())


@pytest.mark.skipif(module.compiler() is None, reason="compiles the producer")
def test_its_bytes_are_on_the_medium_before_its_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """After a power cut an empty file would be taken for the producer, and never compiled again."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    forced: list[str] = []

    def force(descriptor: int) -> None:
        forced.append(str(Path(f"/proc/self/fd/{descriptor}").readlink()))
        assert not list(tmp_path.glob("tdi-acquire/*.cti"))

    monkeypatch.setattr(os, "fsync", force)
    assert module.build().name in [Path(each).name for each in forced]
