"""A dozen processes of recording daemons are killed at seeded moments; `tools/kill_storm.py` kills more."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.kill_storm import Storm


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_acknowledged_line_is_lost(tmp_path: Path, seed: int) -> None:
    outcome = Storm(tmp_path, seed).run(4)
    assert outcome.faults == []
    assert outcome.killed.total() == 4
    assert outcome.lines > 1000
