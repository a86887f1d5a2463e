"""The sizes that the paper's figures imply (its Fig. 6 to 11)."""

from __future__ import annotations

import pytest

from acquire.errors import UsageError
from acquire.geometry import Geometry


@pytest.mark.parametrize(
    ("stages", "lines", "N_m", "T_m", "span", "voxels"),
    [
        (64, 263, 3, 1, 980, (980, 64, 64)),
        (64, 263, 1, 980, 980, (1, 192, 192)),
        (54, 1313, 1, 820, 4100, (5, 162, 162)),
        (54, 1313, 3, 4, 4100, (1025, 54, 54)),
        (54, 713, 3, 4, 2300, (575, 54, 54)),
        (54, 713, 1, 230, 2300, (10, 162, 162)),
    ],
)
def test_sizes_of_the_figures(
    stages: int, lines: int, N_m: int, T_m: int, span: int, voxels: tuple[int, int, int]
) -> None:
    g = Geometry(stages, 3, lines)
    assert g.span == span
    assert g.video_shape(N_m, T_m) == voxels


def test_trusted_interval_of_fig_9() -> None:
    trusted = Geometry(64, 3, 263).trusted
    assert trusted.stop - trusted.start == 598
    assert trusted.start == 191


def test_kept_substeps_of_fig_8() -> None:
    """Three overlapping segments of 2300 sub-steps leave 2136 + 1972 + 2136."""
    g = Geometry(54, 3, 713)
    assert g.seam_substeps(4) == 164
    assert g.span - g.seam_substeps(4) == 2136
    assert g.span - 2 * g.seam_substeps(4) == 1972


def test_every_line_is_exposed_inside_the_span() -> None:
    g = Geometry(4, 3, 7)
    assert g.line_substeps(0).start == 0
    assert g.line_substeps(6).stop == g.span


def test_trusted_frames_hold_whole_blocks() -> None:
    g = Geometry(4, 3, 20)  # T = 71, trusted sub-steps 11..59
    assert g.trusted_frames(1) == g.trusted == slice(11, 60)
    assert g.trusted_frames(5) == slice(3, 12)
    assert g.trusted_frames(200) == slice(1, 1)
    assert Geometry(4, 3, 2).trusted == slice(11, 11)


def test_sampling_rate_tends_to_its_limit() -> None:
    g = Geometry(64, 3, 10_000_000)
    assert g.sampling_rate() == pytest.approx(2 / (64 * 27), rel=1e-4)
    assert g.sampling_rate(3, 4) == pytest.approx(2 * 9 * 4 / (64 * 27), rel=1e-4)


@pytest.mark.parametrize(("N_m", "T_m"), [(13, 1), (0, 1), (3.0, 1), ("3", 1), (True, 1)])
def test_impossible_spatial_merges_are_refused(N_m: int, T_m: int) -> None:
    with pytest.raises(UsageError, match=r"N_m = .*1 to 12"):
        Geometry(4, 3, 7).check_merge(N_m, T_m)


@pytest.mark.parametrize("T_m", [0, 2**31, 10**24, 2.0, "4", True])
def test_impossible_temporal_merges_are_refused(T_m: int) -> None:
    with pytest.raises(UsageError, match=r"T_m = .*1 to 2147483647"):
        Geometry(4, 3, 7).check_merge(3, T_m)
    assert Geometry(4, 3, 7).video_shape(3, 2**31 - 1) == (1, 4, 4)


@pytest.mark.parametrize("bad", [(0, 3, 5), (4, -1, 5), (4, 3, 2.5), (4, 3, True)])
def test_impossible_sizes_are_refused(bad: tuple[int, int, int]) -> None:
    with pytest.raises(UsageError, match="at least 1"):
        Geometry(*bad)
