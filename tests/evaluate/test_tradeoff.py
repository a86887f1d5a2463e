"""The trade-off: intermediate results of one run, the front, the page and the table."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pytest

from acquire.config import load_rig, load_scene
from acquire.config.scene import SineDrive
from acquire.errors import UsageError
from acquire.evaluate.cases import full_wells, procedural
from acquire.evaluate.host import Busyness
from acquire.evaluate.tradeoff import Point, TradeoffRun, TruthJudge, amplitude_error, measure, pareto, table
from acquire.evaluate.tradeoff_page import write_page
from acquire.recon.segments import Voxels
from acquire.sim.leds import LedConfig, LedSceneConfig
from acquire.simulate import Study, Worth, simulate
from acquire.store import open_recording

VOXELS = Voxels(2, 1)
HEADING = {
    "title": "one LED",
    "command": "acquire tradeoff",
    "notes": ["Two repeats."],
    "host": Busyness(cores=2, load=0.2, share=1.0, least_share=0.97).facts(),
}


@pytest.fixture(scope="module")
def judge(tmp_path_factory):
    rig = load_rig("rig-demo", {"geometry.stages": 12, "geometry.substeps": 2})
    drive = SineDrive(waveform="sine", frequency_hz=2000.0, low=0.1)
    led = LedConfig(name="x", shape="square", row=0.5, column=0.5, size=0.5, drive=drive)
    path = tmp_path_factory.mktemp("t") / "r.zarr"
    simulate(rig, LedSceneConfig(kind="leds", title="one", leds=(led,)), path, 160)
    recording = open_recording(path)
    return TruthJudge.of(recording, recording.cut(20, 120))


@pytest.fixture(scope="module")
def run(judge):
    return measure(judge, "admm", VOXELS)


def test_intermediate_results_of_one_run_are_evaluated(judge, run):
    assert all(one.seconds < other.seconds for one, other in pairwise(run.points))
    assert all(one.processor_s <= other.processor_s for one, other in pairwise(run.points))
    assert all(one.iterations <= other.iterations for one, other in pairwise(run.points))
    assert len(run.points) > 3
    assert 1 <= run.points[0].iterations < run.end.iterations
    assert run.end.psnr_db > run.points[0].psnr_db + 10
    assert run.end.frequency_error_hz < 60
    assert 0 <= run.end.amplitude_error < 0.5
    assert not run.cut
    true = judge.truth(VOXELS)
    assert run.mean_db == pytest.approx(10 * np.log10(true.max() ** 2 / true.var(axis=0).mean()), abs=0.01)


def test_a_run_that_exceeds_its_budget_is_marked_as_cut(judge):
    short = measure(judge, "twist", VOXELS, preset="best", longest_s=0.2)
    assert short.cut
    assert not replace(short, ended="converged").cut


def test_the_end_of_a_run_has_the_time_of_its_solver_alone(judge, monkeypatch):
    """Results before the end come without an estimate of their error."""

    def estimate(*_, **__):
        raise AssertionError("the error was estimated")

    monkeypatch.setattr("acquire.recon.api.estimate_error", estimate)
    assert measure(judge, "admm", VOXELS, preset="fast").end.psnr_db is not None


def test_a_real_recording_has_no_truth(judge):
    blind = measure(TruthJudge(judge.segment, None), "admm", VOXELS, preset="fast")
    assert blind.end.psnr_db is None
    assert 0 < blind.end.prediction < 1
    assert blind.end.frame is not None


def test_a_dark_segment_is_refused_before_it_is_reconstructed(judge, monkeypatch):
    monkeypatch.setattr("acquire.evaluate.tradeoff.reconstruct", None)
    dark = TruthJudge(judge.segment, None, np.zeros(judge.segment.geometry.video_shape(1, 1), np.float32))
    with pytest.raises(UsageError, match="dark in the frames of lines 20 to 139"):
        measure(dark, "admm", VOXELS)


def test_the_truth_of_the_baseline_is_in_its_own_pixels_and_sub_steps(tmp_path):
    rig = load_rig("rig-interline", {"geometry.stages": 12})
    simulate(rig, load_scene("scene-usaf-interline"), tmp_path / "r.zarr", 100)
    recording = open_recording(tmp_path / "r.zarr")
    judge = TruthJudge.of(recording, recording.cut(20, 60))
    geometry = judge.segment.geometry
    true = judge.truth(Voxels(1, 1))
    assert true.shape == (len(range(geometry.span)[geometry.trusted]), 12, 12)
    found = measure(judge, "admm", Voxels(1, geometry.span), preset="fast").end
    assert found.psnr_db > 25


def test_procedural_scenes_differ_from_repeat_to_repeat_and_have_their_truth():
    case = procedural("splash", 1e4, 40)
    one, other = case.judge(0), case.judge(1)
    assert case.name == "splash, 10000 electrons at the brightest"
    assert not np.array_equal(one.segment.code, other.segment.code)
    true = one.truth(Voxels(6, 1))
    assert true.shape[1:] == (32, 32)
    assert 0 <= one.picked(Voxels(6, 1)) < len(true)
    np.testing.assert_allclose(true.mean(), one.light.mean(), rtol=0.3)


def test_full_wells_are_electrons_or_clean():
    assert full_wells(["1e4", "clean"]) == [1e4, np.inf]
    with pytest.raises(UsageError, match="full well 'dirty'"):
        full_wells(["dirty"])


def test_halved_amplitudes_have_an_error_of_one_half():
    truth = np.sin(np.arange(40))[:, None, None] * np.ones((40, 3, 3))
    assert amplitude_error(0.5 * truth + 7, truth) == pytest.approx(0.5)
    assert amplitude_error(truth, np.ones_like(truth)) is None


def point(iterations, seconds, decibel):
    return Point(iterations, seconds, psnr_db=decibel)


def test_the_front_holds_results_that_nothing_reaches_sooner():
    slow = TradeoffRun("twist", VOXELS, "float32", 9, (point(1, 1.0, 5.0), point(2, 9.0, 30.0)))
    fast = TradeoffRun("admm", VOXELS, "float32", 9, (point(1, 2.0, 20.0), point(2, 4.0, 19.0)))
    assert [(each.solver, at.iterations) for each, at in pareto([slow, fast])] == [
        ("twist", 1),
        ("admm", 1),
        ("twist", 2),
    ]
    assert [row["pareto"] for row in table([slow, fast])] == [True, True, True, False]


def test_a_study_of_lost_lines_alone_has_no_plot(run, tmp_path):
    """They are not compared with the noise, and the plot had no point to scale its axes by."""
    study = Study(1.0, 100.0, 2.0, 2.5, (Worth("dropped_lines", "stream", 0.0, None, 0.5),))
    write_page([run], {}, study, directory=tmp_path, heading=HEADING, when=datetime.now(UTC))
    document = json.loads((tmp_path / "tradeoff.json").read_text())
    assert [each["effect"] for each in document["study"]["effects"]] == ["dropped_lines"]
    assert not list(tmp_path.glob("effects*"))
    assert "The simulator's effects" not in (tmp_path / "index.html").read_text(encoding="utf-8")


def test_page_and_table_agree(judge, run, tmp_path):
    cut = replace(run, repeat=1, ended="budget")
    exact = replace(run, dtype="float64", case="another")
    true = judge.truth(VOXELS)[judge.picked(VOXELS)]
    page = write_page(
        [run, cut, exact],
        {("", VOXELS): true},
        None,
        directory=tmp_path,
        heading=HEADING,
        when=datetime.now(UTC),
    )
    text = page.read_text()
    assert text.count("<picture>") == 2 * 6  # PSNR by two clocks, frames, SSIM, amplitude, frequency
    assert text.count('<figure class="player') == 2
    assert "a busy thread got 100 % of a core, and at worst 97 %" in text
    assert "The machine was busy" not in text
    assert "cut, 1 of 2" in text
    assert f"The truth&#39;s mean over time, shown as a still, has {run.mean_db:.0f} dB" in text
    assert "cut by its time limit after" in text
    assert f"{run.end.psnr_db:.1f}" in text
    with (tmp_path / "tradeoff.csv").open() as file:
        rows = list(csv.DictReader(file))
    every = [*run.points, *cut.points, *exact.points]
    assert [float(row["psnr_db"]) for row in rows] == [each.psnr_db for each in every]
    assert [row["ended"] for row in rows].count("budget") == 1
    document = json.loads((tmp_path / "tradeoff.json").read_text())
    assert document["rows"][-1]["dtype"] == "float64"
    assert [part["case"] for part in document["sections"]] == ["", "another"]
