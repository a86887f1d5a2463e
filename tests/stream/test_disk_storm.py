"""Recordings on two disks with moods; `tools/disk_storm.py` makes more of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.disk_storm import TAKES, Outcome, run


@pytest.mark.parametrize("seed", [105, 7])
def test_every_recording_ends_and_the_books_balance(tmp_path: Path, seed: int) -> None:
    outcome = Outcome()
    run(tmp_path, seed, outcome)
    assert outcome.faults == []
    assert outcome.ends.total() + outcome.refused == TAKES
