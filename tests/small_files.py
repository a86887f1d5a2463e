"""A file system that takes no files of more than so many bytes, as a full disk does, for one command."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from acquire.store import write_video


def run_with_small_files(most_bytes: int, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command line ``words`` in a process that can write ``most_bytes`` of each file.

    Lines of its output stay whole.
    """
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({most_bytes}, -1));"
    program = [sys.executable, "-c", f"{limited} from acquire.cli import main; raise SystemExit(main())"]
    return subprocess.run(
        [*program, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"COLUMNS": "400"},
    )


def noise_video(path: Path) -> Path:
    """Write a video of noise, which no format compresses below 20 kB, and return its path."""
    frames = np.random.default_rng(8).random((8, 64, 64)).astype(np.float32)
    write_video(
        path,
        frames,
        np.arange(8, dtype=np.int64),
        pixel_size=2.5,
        frame_interval_ns=1,
        provenance={},
    )
    return path
