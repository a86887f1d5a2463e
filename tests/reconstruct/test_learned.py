"""What a trade-off taught is used by a budget."""

from __future__ import annotations

from acquire.reconstruct.learned import Learned, choose, recall, remember

FAST = Learned("admm", "fast", 3, 1, 1000, 2.0, 25.0)
GOOD = Learned("admm", "balanced", 3, 1, 1000, 8.0, 32.0)


def test_the_best_that_ends_in_time():
    known = [FAST, GOOD]
    assert choose(known, 10.0, 1000) == GOOD
    assert choose(known, 5.0, 1000) == FAST
    assert choose(known, 5.0, 500) == GOOD  # half the voxels take half the time
    assert choose(known, 1.0, 1000) is None
    assert choose([], 1.0, 1000) is None


def test_lessons_are_kept_and_replaced(tmp_path):
    path = tmp_path / "cache" / "t.json"
    assert recall(path) == []
    remember([FAST], path)
    better = Learned("admm", "fast", 3, 1, 1000, 1.0, 26.0)
    remember([better, GOOD], path)
    assert sorted(recall(path), key=lambda each: each.seconds) == [better, GOOD]
    path.write_text("{")
    assert recall(path) == []
