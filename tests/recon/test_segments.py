"""Seams and stitching: every sub-step once, whatever the voxels; the sizes of Fig. 5, 8 and 11."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.errors import UsageError
from acquire.recon.segments import Grid, Stitcher, Stream, Stretch, Voxels, split

FAST, SLOW = Voxels(3, 4), Voxels(1, 230)


def plan_of_fig_8():
    stream = Stream(54, 3, 0, 3000)
    edges = [0, 2136, 2136 + 1972, 6244]
    kinds = (FAST, stream.evened(SLOW, 1972), FAST)
    return stream, [Stretch(a, b, v) for a, b, v in zip(edges, edges[1:], kinds, strict=False)]


def test_the_sizes_of_fig_8():
    stream, stretches = plan_of_fig_8()
    a, b, c = stream.arrange(stretches)
    assert stream.geometry(1).seam_substeps(4) == 164
    # fast ones have lines beyond their ends: n − 1 sub-steps up to whole voxels, then down to a whole line
    assert c.begin - 3 * c.first_line in range(164, 164 + 3)
    assert 3 * (a.first_line + a.lines) >= a.end
    # the slow one has those that see nothing but it, in voxels that fill it
    assert 3 * b.first_line in range(b.begin - 2, b.begin + 1)
    assert stream.geometry(b.lines).span + 3 * b.first_line in range(b.end, b.end + 3)
    assert b.voxels == Voxels(1, 220)


def test_the_detail_of_fig_7_takes_all_lines():
    (only,) = Stream(54, 3, 0, 1313).arrange([Stretch(0, 4100, Voxels(1, 820))])
    assert (only.first_line, only.lines) == (0, 1313)


def test_fig_9_s_interval_is_what_263_lines_sample():
    stream = Stream(64, 3, 1733, 1733 + 263)
    begin, end = stream.extent(Voxels(3, 1), Voxels(3, 1), whole=False)
    assert end - begin == 598
    assert stream.sub_segment(Stretch(begin, end, Voxels(3, 1))).lines == 263


streams = st.tuples(st.integers(2, 9), st.integers(1, 4))


@st.composite
def arranged(draw):
    stages, substeps = draw(streams)
    size = stages * substeps
    stream = Stream(stages, substeps, 0, 10_000)
    edge, stretches = 2 * size + draw(st.integers(0, 50)), []
    for _ in range(draw(st.integers(1, 4))):
        length = draw(st.integers(1, 4 * size))
        voxels = Voxels(draw(st.integers(1, size)), draw(st.integers(1, 2 * size)))
        stretches.append(Stretch(edge, edge + length, stream.evened(voxels, length)))
        edge += length
    return stream, stretches, draw(st.integers(0, 3 * size))


@settings(max_examples=150, deadline=None)
@given(arranged(), st.integers(1, 6))
def test_weights_of_all_sub_segments_add_up_to_one(case, merge):
    stream, stretches, fade = case
    grid = Grid.finest(stretches, stream.geometry(1).size, Voxels(1, merge))
    total = np.zeros(grid.frames)
    for segment in stream.arrange(stretches, fade):
        weights = grid.weights(segment)
        assert weights.min() >= -1e-5
        total[grid.frames_of(segment)] += weights
    np.testing.assert_allclose(total, 1, atol=1e-4)


@settings(max_examples=100, deadline=None)
@given(arranged())
def test_the_lines_of_a_sub_segment_sample_all_that_it_shows(case):
    stream, stretches, fade = case
    for segment in stream.arrange(stretches, fade):
        geometry, origin = stream.geometry(segment.lines), stream.substeps * segment.first_line
        begin, end = segment.shown
        if stream.is_slow(segment.voxels):
            assert origin <= begin
            assert end <= origin + geometry.span + stream.substeps
            continue
        # the whole voxels that are shown lie in the trusted interval
        T_m, trusted = segment.voxels.temporal_merge, geometry.trusted
        assert (begin - origin) // T_m * T_m >= trusted.start
        assert -(-(end - origin) // T_m) * T_m <= trusted.stop + T_m * (trusted.stop >= geometry.span)


@settings(max_examples=40, deadline=None)
@given(arranged(), st.integers(0, 2**31))
def test_a_scene_that_every_voxel_represents_is_stitched_without_a_seam(case, seed):
    """Exact voxels of a uniform scene of constant light are reproduced on any grid."""
    stream, stretches, fade = case
    size = stream.geometry(1).size
    grid = Grid.finest(stretches, size)
    level = np.float32(np.random.default_rng(seed).uniform(0.1, 5))
    segments = stream.arrange(stretches, fade)
    stitcher, seen = Stitcher(grid), []
    for segment, following in zip(segments, [*segments[1:], None], strict=True):
        shape = stream.geometry(segment.lines).video_shape(
            segment.voxels.spatial_merge, segment.voxels.temporal_merge
        )
        frames = grid.resample(np.full(shape, level, np.float32), segment, stream.substeps)
        (done,) = stitcher.add(segment, (frames,), following)
        seen.append(done)
    video = np.concatenate(seen)
    assert video.shape == (grid.frames, grid.side, grid.side)
    np.testing.assert_allclose(video, level, rtol=1e-4)


def test_resampling_takes_means_in_time_and_space():
    stream = Stream(2, 2, 0, 100)
    segment = stream.sub_segment(Stretch(12, 20, Voxels(2, 2)))
    shape = stream.geometry(segment.lines).video_shape(2, 2)
    video = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    fine = Grid(12, 20, 4, Voxels(1, 1)).resample(video, segment, 2)
    first = (12 - 2 * segment.first_line) // 2
    np.testing.assert_allclose(fine[0], np.kron(video[first], np.ones((2, 2))))
    np.testing.assert_allclose(fine[0], fine[1])
    coarse = Grid(12, 20, 4, Voxels(4, 4)).resample(video, segment, 2)
    np.testing.assert_allclose(coarse[0], video[first : first + 2].mean(), rtol=1e-6)


@settings(max_examples=200, deadline=None)
@given(
    stages=st.integers(1, 8),
    substeps=st.integers(1, 3),
    lines=st.integers(1, 60),
    side=st.integers(1, 4),
    frames_of_n=st.floats(0.1, 3),
    longest=st.integers(1, 100),
)
def test_no_sub_segment_needs_lines_that_are_not_there(stages, substeps, lines, side, frames_of_n, longest):
    """Slow voxels after the last line's first sub-step began with a line beyond it, which was refused."""
    stream, size = Stream(stages, substeps, 7, 7 + lines), stages * substeps
    voxels = Voxels(min(side, size), max(1, round(frames_of_n * size)))
    begin, end = stream.extent(voxels, voxels, whole=True)
    for each in stream.arrange(split(begin, end, voxels, longest), fade=3):
        assert 7 <= each.first_line < each.first_line + each.lines <= 7 + lines
        assert substeps * each.first_line <= each.begin
        assert substeps * each.first_line + stream.geometry(each.lines).span >= each.end


def test_a_piece_is_no_longer_than_allowed():
    parts = split(7, 4007, Voxels(3, 4), 600)
    assert parts[0].begin == 7
    assert parts[-1].end == 4007
    assert all(a.end == b.begin for a, b in pairwise(parts))
    assert max(part.end - part.begin for part in parts) <= 600
    assert all((part.begin - 7) % 4 == 0 for part in parts)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: Stretch(5, 5, FAST),
        lambda: Stream(54, 3, 0, 3000).arrange([Stretch(0, 5, FAST), Stretch(6, 9, FAST)]),
        lambda: Stream(64, 3, 0, 50).extent(FAST, FAST, whole=False),
    ],
)
def test_what_cannot_be_is_refused(wrong):
    with pytest.raises(UsageError):
        wrong()
