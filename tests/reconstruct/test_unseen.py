"""Frames that an arm did not see are not trusted, and sub-segments that none saw are refused at once."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import zarr

from acquire.errors import UsageError
from acquire.flags import LineFlag
from acquire.recon import reconstruct
from acquire.recon.segments import Voxels
from acquire.recon.unseen import Unseen, find_unseen, longest, remaining, within
from acquire.reconstruct import (
    Monitor,
    Options,
    by_lines,
    combine,
    describe,
    in_voxels,
    open_pool,
)
from acquire.store import open_recording

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.reconstruct import Outcome
    from acquire.store import Recording

M, S = 12, 2
N = M * S


def spoiled(source: Path, path: Path, lines: range, arms: str = "a", *, lost: bool = False) -> Recording:
    """A copy of a recording with saturated or lost lines."""
    shutil.copytree(source, path)
    rows, white = slice(lines.start, lines.stop), open_recording(source).attrs["cameras"]["a"]["white_dn"]
    for arm in arms:
        group = zarr.open_group(path / arm, mode="r+")
        for name, of_lines in (("lines", 0 if lost else round(white)), ("flags", 0)):
            array = group[name]
            assert isinstance(array, zarr.Array)
            values = np.asarray(array[:])
            values[rows] = of_lines if name == "lines" else LineFlag.MISSING if lost else LineFlag.SATURATED
            array[:] = values
    return open_recording(path)


def video_of(recording: Recording, path: Path, lines: int = 300, longest: int = 200) -> Outcome:
    request = in_voxels(by_lines(recording, 20, lines), Voxels(4, 2), longest=longest)
    options = Options(iterations=2, check=False, error=False, solver="twist")
    monitor = Monitor(len(request.stretches))
    with open_pool(len(request.stretches), 1, watch=monitor) as pool:
        return combine(recording, request, path, options=options, pool=pool, monitor=monitor)


@pytest.mark.parametrize(("arm", "lost", "why"), [("a", False, "saturated"), ("b", True, "lost")])
def test_frames_that_one_arm_did_not_see_are_withdrawn_and_named(
    recording_path: Path, tmp_path: Path, arm: str, lost: bool, why: str
) -> None:
    lines = range(110, 150)
    recording = spoiled(recording_path, tmp_path / "r.zarr", lines, arm, lost=lost)
    facts = video_of(recording, tmp_path / "v.zarr").provenance
    (said,) = [text for text in facts["warnings"] if "no usable sample" in text]
    # Seen only by lines of the gap: line ℓ exposes the sub-steps ℓS to ℓS + n + S − 2.
    begin, end = S * lines.start + N - 1, S * lines.stop
    first, last = (begin - facts["first_substep"] + 1) // 2, (end - facts["first_substep"]) // 2 - 1
    assert said.startswith(f"frames {first} to {last} are not trusted: arm {arm} has no usable sample")
    assert f"lines {lines.start} to {lines.stop - 1} are {why}" in said
    whole = facts["segments"][-1]["end_substep"] - facts["first_substep"]
    assert facts["trusted"] == [last + 1, whole // 2]
    assert whole // 2 - last - 1 > first, "the longer run is the one behind"


def test_lines_that_both_arms_have_withdraw_nothing(recording_path: Path, tmp_path: Path) -> None:
    """A gap shorter than a pass of the scene leaves samples of every frame."""
    recording = spoiled(recording_path, tmp_path / "r.zarr", range(150, 150 + M))
    facts = video_of(recording, tmp_path / "v.zarr").provenance
    whole = video_of(open_recording(recording_path), tmp_path / "w.zarr").provenance
    assert facts["trusted"] == whole["trusted"]
    assert not any("no usable sample" in text for text in facts["warnings"])


def test_a_reconstruction_in_memory_trusts_the_frames_that_its_record_does(
    recording_path: Path, tmp_path: Path
) -> None:
    """The record left them out, and `result.trusted` had them."""
    recording = spoiled(recording_path, tmp_path / "r.zarr", range(30, 60))
    segment = recording.cut(0, 80)
    result = reconstruct(segment, 4, 3, iterations=2, check=False, error=False, solver="twist")
    facts = describe(result, recording, segment)
    (unseen,) = find_unseen(segment, 3)
    first, stop = unseen.begin // 3, unseen.end // 3
    sampled = segment.geometry.trusted_frames(3)
    assert sampled.start < first < stop < sampled.stop
    assert result.trusted == slice(sampled.start, first)
    assert facts["trusted"] == [sampled.start, first]
    (said,) = [text for text in result.warnings if "no usable sample" in text]
    assert said.startswith(f"frames {first} to {stop - 1} are not trusted: arm a")
    assert facts["warnings"].count(said) == 1


@pytest.mark.parametrize("lost", [False, True], ids=["saturated", "flagged as missing"])
def test_a_sub_segment_without_a_usable_sample_is_refused_before_the_others_are_solved(
    recording_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: bool
) -> None:
    """It was found out when its turn came, after the minutes that the others took."""
    recording = spoiled(recording_path, tmp_path / "r.zarr", range(90, 260), "ab", lost=lost)
    monkeypatch.setattr(
        "acquire.reconstruct.pools.solve", lambda *_: pytest.fail("a sub-segment has been solved")
    )
    with pytest.raises(UsageError, match=r"none of their samples is usable.*possible: lines before them"):
        video_of(recording, tmp_path / "v.zarr")
    assert [path.name for path in tmp_path.iterdir()] == ["r.zarr"]


def test_lines_that_are_saturated_in_one_sample_are_not_refused(recording_path: Path, tmp_path: Path) -> None:
    """Their flag is that of lines without any usable sample."""
    recording = spoiled(recording_path, tmp_path / "r.zarr", range(90, 260), "ab")
    for arm in "ab":
        array = zarr.open_group(recording.path / arm, mode="r+")["lines"]
        original = zarr.open_group(recording_path / arm, mode="r")["lines"]
        assert isinstance(array, zarr.Array)
        assert isinstance(original, zarr.Array)
        values = np.asarray(original[:])
        values[90:260, 0] = np.asarray(array[:])[90:260, 0]
        array[:] = values
    outcome = video_of(open_recording(recording.path), tmp_path / "v.zarr")
    assert len(outcome.provenance["segments"]) == outcome.provenance["segments_asked"]


def test_ranges_of_one_arm_join_and_what_remains_is_found() -> None:
    one = Unseen(10, 20, "a", 1, 9, "lost")
    joined = within([replace(one, begin=20, end=30, last_line=12), one, replace(one, arm="b")], 12, 25)
    assert [(each.arm, each.begin, each.end, each.last_line) for each in joined] == [
        ("a", 12, 25, 12),
        ("b", 12, 20, 9),
    ]
    assert remaining((0, 40), joined) == [(0, 12), (25, 40)]
    assert remaining((12, 25), joined) == []
    assert longest(remaining((0, 40), joined), 0) == (25, 40)
    assert longest([], 7) == (7, 7)
