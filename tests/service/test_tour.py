"""README.md's tour of five minutes: every block is executed unchanged in a fresh directory."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from live_daemon import COMMAND
from PIL import Image

from acquire.store import open_recording, open_video, verify

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
TOUR = README.partition("## A tour of five minutes")[2].partition("\n## ")[0]
STEPS = re.findall(r"```(sh|python)\n(.*?)```", TOUR, re.DOTALL)
SHELL = "set -e\ntrap 'jobs -p | xargs -r kill; wait' EXIT\n"
"""Whatever fails, the service that a block has started ends with it."""
RESULT = "\nimport numpy\nnumpy.save('trusted.npy', video)\n"


@pytest.mark.timeout(600)
def test_every_command_of_the_tour_works(tmp_path: Path) -> None:
    assert [kind for kind, _ in STEPS] == ["sh", "sh", "sh", "python"]
    environment = os.environ | {
        "PATH": f"{Path(COMMAND[0]).parent}:{os.environ['PATH']}",
        "XDG_RUNTIME_DIR": str(tmp_path),  # where the service listens by default
    }
    environment.pop("ACQUIRE_SOCKET", None)
    said = ""
    for kind, block in STEPS:
        words = ["bash", "-c", SHELL + block] if kind == "sh" else [sys.executable, "-c", block + RESULT]
        done = subprocess.run(
            words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False
        )
        said += done.stdout
        assert done.returncode == 0, f"{block}\n{done.stdout}\n{done.stderr}"
    take = open_recording(tmp_path / "take.zarr")
    assert (take.state, verify(take.path).intact) == ("sealed", True)
    assert take.lines == pytest.approx(66_667, abs=take.arms["a"].reader("lines").shape.chunk_rows)
    assert "take.zarr: intact; sealed" in said
    fast, fine = (open_video(tmp_path / f"{name}.zarr") for name in ("fast", "fine"))
    assert fast.video.shape[1:] == (64, 64)
    assert fast.scale[0] == pytest.approx(10e-6, rel=1e-3)
    assert fine.video.shape[1:] == (96, 96)
    with Image.open(tmp_path / "both.webp") as both:
        assert getattr(both, "n_frames", 1) > 20
    trusted = np.load(tmp_path / "trusted.npy")
    assert trusted.shape[1:] == (64, 64)
    assert np.isfinite(trusted).all()
