"""The simulated producer's compilation where the compiler does not come to an end."""

from __future__ import annotations

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
