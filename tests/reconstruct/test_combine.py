"""Sub-segments solved one by one and side by side become one video on disk."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from acquire.config.plan import ReconstructionPlan
from acquire.errors import UsageError
from acquire.recon.judge import POOR_MISFIT
from acquire.recon.segments import Voxels
from acquire.reconstruct import (
    Monitor,
    Options,
    along_plan,
    by_lines,
    by_time,
    combine,
    in_glimpses,
    in_voxels,
    open_pool,
)
from acquire.reconstruct.budget import Budget
from acquire.sim.leds import LedSceneConfig
from acquire.sim.scenes import build_scene
from acquire.sim.voxels import truth
from acquire.store import Recording, open_recording, open_video

QUICK = Options(iterations=16)


def run(recording_path, request, path, options=QUICK, workers=1, stop=None):
    recording = open_recording(recording_path)
    monitor = Monitor(len(request.stretches), stop=stop)
    with open_pool(len(request.stretches), workers, watch=monitor) as pool:
        return combine(recording, request, path, options=options, pool=pool, monitor=monitor)


@pytest.fixture
def request_of_three(recording_path):
    selection = by_lines(open_recording(recording_path), 20, 300)
    return in_voxels(selection, Voxels(2, 1), longest=200)


def test_a_long_range_is_stitched_from_pieces(recording_path, request_of_three, tmp_path):
    outcome = run(recording_path, request_of_three, tmp_path / "v.zarr", Options(iterations=30))
    video = open_video(tmp_path / "v.zarr")
    recording = open_recording(recording_path)
    begin, end = request_of_three.grid.begin, request_of_three.grid.end
    assert len(outcome.provenance["segments"]) == 3
    assert video.video.shape == (end - begin, 12, 12) == outcome.shape
    assert outcome.provenance["trusted"] == [0, end - begin]
    assert (np.diff(video.time_ns) == round(video.interval_ns)).all()
    # the first frame that 300 lines sample in full carries the read-out time of the first of them
    assert video.time_ns[0] == recording.camera("a").time_ns[20]
    assert np.isfinite(video.quality).all()
    assert video.error.shape == (end - begin, 8, 8)
    assert np.isfinite(video.error[:]).all()
    told = outcome.provenance["error"]
    assert 0 < told["low"] < told["rms"] < told["high"] < told["full_scale"]
    scene = build_scene(LedSceneConfig.model_validate(recording.attrs["scene"]), 24, 1e-5)
    expected = truth(scene, begin, end - begin, 2)
    error = video.video[:] - expected
    assert np.sqrt(np.mean(error**2)) < 0.1 * expected.max()
    assert told["rms"] / 3 < np.sqrt(np.mean(error**2)) < 3 * told["rms"]
    # across a seam, frames change as they do elsewhere
    steps = np.sqrt(np.mean(np.diff(video.video[:], axis=0) ** 2, axis=(1, 2)))
    seams = [stretch.begin - begin for stretch in request_of_three.stretches[1:]]
    assert max(steps[seam - 33 : seam + 33].max() for seam in seams) < 2 * np.quantile(steps, 0.95)


def test_several_processes_give_the_result_of_one(recording_path, request_of_three, tmp_path):
    run(recording_path, request_of_three, tmp_path / "one.zarr")
    run(recording_path, request_of_three, tmp_path / "two.zarr", workers=2)
    one, two = (open_video(tmp_path / name).video[:] for name in ("one.zarr", "two.zarr"))
    np.testing.assert_allclose(one, two, atol=1e-2)  # sums in another order


def test_a_plan_brings_different_voxels_to_one_grid(recording_path, tmp_path):
    plan = ReconstructionPlan.model_validate(
        {
            "segments": [
                {"name": "fast", "substeps": 150, "spatial_merge": 2, "temporal_merge": 3},
                {"name": "fine", "lines": 50, "spatial_merge": 1, "temporal_merge": 30},
                {"name": "rest", "spatial_merge": 2, "temporal_merge": 3},
            ]
        }
    )
    selection = by_lines(open_recording(recording_path), 20, 250)
    request = along_plan(selection, plan)
    outcome = run(recording_path, request, tmp_path / "v.zarr")
    fast, fine, rest = outcome.provenance["segments"]
    assert [part["name"] for part in (fast, fine, rest)] == ["fast", "fine", "rest"]
    assert fine["begin_substep"] == fast["end_substep"] == request.grid.begin + 150
    assert fine["temporal_merge"] == 34  # three that fill 100 sub-steps
    assert outcome.shape[1:] == (24, 24)
    video = open_video(tmp_path / "v.zarr").video[:]
    frames = slice(52, 60)  # inside "fine": held over its voxels
    assert np.ptp(video[frames], axis=0).max() < 1e-6


@pytest.mark.parametrize(("temporal_merge", "longest"), [(1, 4 * 24), (24, 32 * 24)])
def test_sub_segments_are_as_long_as_their_voxels_need(recording_path, temporal_merge, longest):
    request = in_voxels(by_lines(open_recording(recording_path)), Voxels(2, temporal_merge))
    lengths = [each.end - each.begin for each in request.stretches]
    assert max(lengths) <= longest
    assert len(lengths) == -(-sum(lengths) // longest), "as few as possible"


def test_times_select_the_lines_they_need(recording_path):
    recording = open_recording(recording_path)
    request = in_voxels(by_time(recording, 1_000_000, 3_000_000), Voxels(2, 1))
    assert request.grid.frames == 200
    segment = request.stream.arrange(request.stretches)[0]
    read_out = recording.camera("a").time_ns
    assert read_out[segment.first_line] - read_out[0] <= 1_000_000
    with pytest.raises(UsageError, match=r"0us to 1000s .*\n?.*possible: 0us to .*ms \(sub-steps 23 to"):
        in_voxels(by_time(recording, 0, 10**12), Voxels(2, 1))


def test_glimpses_show_the_whole_range_from_few_lines(recording_path, tmp_path):
    selection = by_lines(open_recording(recording_path))
    request = in_glimpses(selection, Voxels(4, 8), 4)
    pieces = request.sub_segments()
    assert [piece.lines for piece in pieces] == [pieces[0].lines] * 4
    assert sum(piece.lines for piece in pieces) < request.stream.end_line / 1.5
    outcome = run(recording_path, request, tmp_path / "v.zarr", Options(iterations=30))
    written = open_video(tmp_path / "v.zarr")
    assert outcome.shape == (4, 6, 6)
    recording = open_recording(recording_path)
    scene = build_scene(LedSceneConfig.model_validate(recording.attrs["scene"]), 24, 1e-5)
    for frame, piece in zip(written.video[:], pieces, strict=True):
        there = truth(scene, piece.seen[0], 8, 4, 8)[0]
        assert np.sqrt(np.mean((frame - there) ** 2)) < 0.2 * there.max()
    step_ns = np.diff(written.time_ns)
    np.testing.assert_allclose(step_ns, written.interval_ns, atol=1)


def test_glimpses_of_a_short_range_are_refused(recording_path):
    selection = by_lines(open_recording(recording_path), 0, 100)
    assert len(in_glimpses(selection, Voxels(4, 8), 22).sub_segments()) == 22  # which share lines
    with pytest.raises(UsageError, match=r"23 glimpses of .*\(176 sub-steps\).*up to 22"):
        in_glimpses(selection, Voxels(4, 8), 23)


def test_results_before_a_stop_are_kept_and_marked(recording_path, request_of_three, tmp_path):
    calls = iter(range(10_000))
    outcome = run(recording_path, request_of_three, tmp_path / "v.zarr", stop=lambda: next(calls) > 24)
    video = open_video(tmp_path / "v.zarr")
    assert outcome.interrupted
    assert video.attrs["provenance"]["state"] == "interrupted"
    assert 0 < video.video.shape[0] < request_of_three.grid.frames
    segments = video.attrs["provenance"]["segments"]
    assert [part["trusted"] for part in segments] == [part["ended"] != "stopped" for part in segments]
    assert not segments[-1]["trusted"]
    assert "was stopped after" in segments[-1]["warnings"][0]
    begin = segments[-1]["begin_substep"] - request_of_three.grid.begin
    first, end = video.attrs["provenance"]["trusted"]
    assert first <= end <= begin // request_of_three.grid.voxels.temporal_merge
    assert len(video.time_ns) == video.video.shape[0] == len(video.quality)


@pytest.fixture
def unrefused(monkeypatch):
    """Accept budgets that this machine may be too busy for, or that cannot be kept at all."""
    monkeypatch.setattr(Budget, "check", lambda *_: None)


@pytest.mark.usefixtures("unrefused")
def test_a_budget_is_shared(recording_path, request_of_three, tmp_path):
    options = Options(solver="twist", iterations=100_000, budget_s=1.5)
    outcome = run(recording_path, request_of_three, tmp_path / "v.zarr", options)
    assert all(part["iterations"] < 100_000 for part in outcome.provenance["segments"])
    assert not outcome.interrupted


def test_a_budget_that_began_long_ago_is_refused_and_nothing_written(
    recording_path, request_of_three, tmp_path
):
    recording, began = open_recording(recording_path), time.monotonic() - 30
    path, options, monitor = tmp_path / "v.zarr", Options(budget_s=20), Monitor(3)
    refused = pytest.raises(UsageError, match=r"budget of 20 s .*: these 3 sub-segments need at least 3\d s")
    with open_pool(3, 1) as pool, refused:
        combine(recording, request_of_three, path, options=options, pool=pool, monitor=monitor, began=began)
    assert list(tmp_path.iterdir()) == []


class Stalled:
    """A pool of this process that stalls for ``stall_s`` before the first answer."""

    workers = 1

    def __init__(self, pool, stall_s):
        self._pool, self._stall_s = pool, stall_s

    def submit(self, task):
        time.sleep(self._stall_s)
        self._stall_s = 0.0
        return self._pool.submit(task)

    def share_done(self):
        return self._pool.share_done()


@pytest.mark.usefixtures("unrefused")
def test_a_budget_on_a_busy_machine_keeps_the_results_so_far(recording_path, request_of_three, tmp_path):
    recording, options = open_recording(recording_path), Options(budget_s=3.0)
    with open_pool(3, 1) as pool:
        stalled = Stalled(pool, 3.0)
        outcome = combine(
            recording,
            request_of_three,
            tmp_path / "v.zarr",
            options=options,
            pool=stalled,
            monitor=Monitor(3),
        )
    facts = open_video(tmp_path / "v.zarr").attrs["provenance"]
    assert outcome.cut
    assert (len(facts["segments"]), facts["segments_asked"]) == (1, 3)
    assert facts["state"] == "interrupted"


@pytest.mark.usefixtures("unrefused")
def test_a_sub_segment_with_too_little_time_is_not_trusted(recording_path, request_of_three, tmp_path):
    options = Options(solver="twist", iterations=100_000, budget_s=0.05)
    facts = run(recording_path, request_of_three, tmp_path / "v.zarr", options).provenance
    poor = [part["quality"]["misfit"] > POOR_MISFIT for part in facts["segments"]]
    assert poor == [not part["trusted"] for part in facts["segments"]]
    assert any(poor)
    assert facts["trusted"][1] - facts["trusted"][0] < request_of_three.grid.frames


def test_progress_never_exceeds_the_whole_despite_trials(recording_path, tmp_path):
    """Iterations of trials come on top of the requested ones."""
    request = in_voxels(by_lines(open_recording(recording_path), 20, 60), Voxels(3, 20))
    seen = []
    monitor = Monitor(len(request.stretches), lambda done, tasks: seen.append(done / tasks))
    with open_pool(len(request.stretches), 1, watch=monitor) as pool:
        recording, options = open_recording(recording_path), Options(iterations=8)
        outcome = combine(
            recording, request, tmp_path / "v.zarr", options=options, pool=pool, monitor=monitor
        )
    assert outcome.provenance["iterations"] > outcome.provenance["iterations_asked"]
    assert seen == sorted(seen)
    assert seen[0] < 0.5
    assert seen[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("refused", [True, False], ids=["all lines", "all but one"])
def test_a_sub_segment_without_any_line_is_refused_before_the_others_are_solved(
    recording_path, request_of_three, tmp_path, monkeypatch, refused
):
    """It was found out when its turn came, and the minutes before were lost; nothing said which lines."""
    middle = request_of_three.sub_segments()[1]
    first, end = middle.first_line, middle.first_line + middle.lines
    lost = {
        "a": [range(end - 10, end + 5), range(first - 5, end - 10)],
        "b": [range(3), range(first, end)],
    }
    if not refused:
        lost["b"][1] = range(first, end - 1)
    monkeypatch.setattr(Recording, "lost_rows", lambda self, arm: lost[arm])
    if refused:
        with pytest.raises(UsageError, match=rf"lines {first} to {end - 1}: both arms have lost all"):
            run(recording_path, request_of_three, tmp_path / "v.zarr")
        assert not (tmp_path / "v.zarr").exists()
    else:
        assert run(recording_path, request_of_three, tmp_path / "v.zarr").shape[0] > 0


def test_a_failing_sub_segment_leaves_nothing(recording_path, request_of_three, tmp_path):
    with pytest.raises(UsageError, match="solver"):
        run(recording_path, request_of_three, tmp_path / "v.zarr", Options(solver="magic"), workers=2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_all_processes_ends_none_of_those_that_are_still_starting(
    recording_path, request_of_three, tmp_path, number
):
    """Ctrl-C, and the SIGTERM of `timeout`, reach them too: the command failed for lack of memory."""
    told = set()

    def stop():
        for child in multiprocessing.active_children():
            if child.pid not in told:  # a tenth of a second old
                told.add(child.pid)
                os.kill(child.pid, number)
        return True

    outcome = run(recording_path, request_of_three, tmp_path / "v.zarr", workers=2, stop=stop)
    assert told
    assert outcome.interrupted
    assert open_video(tmp_path / "v.zarr").attrs["provenance"]["state"] == "interrupted"


def test_ctrl_c_keeps_the_best_so_far(recording_path, tmp_path):
    """The command itself, in a separate process with its workers."""
    words = ["reconstruct", recording_path, "--out", tmp_path / "v.zarr", "--nm", 2, "--workers", 2, "--json"]
    with subprocess.Popen(
        [sys.executable, "-m", "acquire", *map(str, words), "--solver", "twist", "--iterations", "1000000"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    ) as process:
        deadline = time.monotonic() + 300
        while not _has_worked(process.pid):
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        out, error = process.communicate(timeout=300)
    assert process.returncode == 130, error
    facts = json.loads(out)
    assert facts["state"] == "interrupted"
    assert facts["segments"][0]["iterations"] < 1_000_000
    assert facts["trusted"] == [0, 0]
    assert b"press Ctrl-C again to end now" in error
    assert open_video(tmp_path / "v.zarr").attrs["provenance"]["state"] == "interrupted"
    assert [path.name for path in tmp_path.iterdir()] == ["v.zarr"]


def _has_worked(pid: int) -> bool:
    """Whether one of its child processes has computed for a while, and so is past its imports."""
    import psutil

    try:
        below = psutil.Process(pid).children(recursive=True)
        return sum(each.cpu_times().user > 4 for each in below) > 0
    except psutil.NoSuchProcess:
        return False
