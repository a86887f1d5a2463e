"""Held-out samples: whole blocks of usable samples, in the requested number."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import label

from acquire.errors import UsageError
from acquire.recon.holdout import held_out_blocks


def test_blocks_of_lines_and_pixels_that_hold_the_share() -> None:
    usable = np.ones((2, 263, 64), bool)
    shares = [held_out_blocks(usable, 0.08, seed).mean() for seed in range(20)]
    assert np.mean(shares) == pytest.approx(0.08, abs=0.005)
    for arm in held_out_blocks(usable, 0.08, 1):
        _, blocks = label(arm)
        assert arm.any()
        assert arm.sum() / blocks > 24 * 4 / 2  # a border cuts a block, and neighbours count as one


def test_seeds_and_arms_differ_and_unusable_samples_are_left_out() -> None:
    usable = np.ones((2, 120, 32), bool)
    usable[0, 40:80] = False
    one, other = (held_out_blocks(usable, 0.1, seed) for seed in (1, 2))
    assert (one != other).any()
    assert (one[0] != one[1]).any()
    assert not (one & ~usable).any()
    assert (one == held_out_blocks(usable, 0.1, 1)).all()


def test_small_segments_have_smaller_blocks() -> None:
    found = [held_out_blocks(np.ones((2, 40, 8), bool), 0.08, seed).sum() for seed in range(10)]
    assert min(found) > 0
    assert np.mean(found) == pytest.approx(0.08 * 640, rel=0.3)


def test_nothing_is_held_out_for_a_share_of_0_or_without_usable_samples() -> None:
    assert not held_out_blocks(np.ones((2, 40, 8), bool), 0.0, 0).any()
    assert not held_out_blocks(np.zeros((2, 40, 8), bool), 0.1, 0).any()


@pytest.mark.parametrize(("share", "lines"), [(0.6, 24), (-0.1, 24), (0.1, 0)])
def test_impossible_shares_and_blocks_are_refused(share: float, lines: int) -> None:
    with pytest.raises(UsageError, match="held-out"):
        held_out_blocks(np.ones((2, 40, 8), bool), share, 0, lines=lines)
