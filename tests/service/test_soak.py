"""A few cycles of `tools/soak.py`: faults by schedule, books to the line, nothing grows."""

from __future__ import annotations

from pathlib import Path

from tools.soak import soak


def test_every_line_has_a_fate_and_nothing_grows(tmp_path: Path) -> None:
    found = soak(tmp_path, 60_000, 10_000.0, seed=1)
    assert found.wrong == []
    assert found.cycles >= 2
    assert found.faults.total() >= 4
    (_, handles, threads), *_, (_, handles_end, threads_end) = found.usage
    assert (handles_end, threads_end) == (handles, threads)
    assert not any(tmp_path.iterdir())
