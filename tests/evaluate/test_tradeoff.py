"""The trade-off: what is measured on the way, the front, the page and the table."""

from __future__ import annotations

import csv
import json
from datetime import UTC, datetime

import numpy as np
import pytest

from acquire.config import load_rig
from acquire.evaluate.tradeoff import Judge, Point, Run, amplitude_error, measure, pareto, table
from acquire.evaluate.tradeoff_page import write_page
from acquire.recon.segments import Voxels
from acquire.scene_config import LedConfig, LedSceneConfig, SineDrive
from acquire.simulate import simulate
from acquire.store import open_recording

VOXELS = Voxels(2, 1)


@pytest.fixture(scope="module")
def judge(tmp_path_factory):
    rig = load_rig("rig-demo", {"geometry.stages": 12, "geometry.substeps": 2})
    drive = SineDrive(waveform="sine", frequency_hz=2000.0, low=0.1)
    led = LedConfig(name="x", shape="square", row=0.5, column=0.5, size=0.5, drive=drive)
    path = tmp_path_factory.mktemp("t") / "r.zarr"
    simulate(rig, LedSceneConfig(kind="leds", title="one", leds=(led,)), path, 160)
    recording = open_recording(path)
    return Judge.of(recording, recording.cut(20, 120))


def test_more_and_more_iterations_up_to_the_presets(judge):
    run = measure(judge, "admm", VOXELS)
    counts = [point.iterations for point in run.points]
    assert counts == sorted(counts)
    assert {preset for point in run.points for preset in point.presets} == {"fast", "balanced"}
    assert run.end.psnr_db > run.points[0].psnr_db
    assert run.end.frequency_error_hz < 60
    assert 0 <= run.end.amplitude_error < 0.5


def test_a_real_recording_has_no_truth(judge):
    run = measure(Judge(judge.segment, None), "admm", VOXELS, ("fast",))
    assert run.end.psnr_db is None
    assert 0 < run.end.prediction < 1


def test_amplitudes_that_are_half_are_wrong_by_half():
    truth = np.sin(np.arange(40))[:, None, None] * np.ones((40, 3, 3))
    assert amplitude_error(0.5 * truth + 7, truth) == pytest.approx(0.5)
    assert amplitude_error(truth, np.ones_like(truth)) is None


def point(iterations, seconds, decibel):
    return Point(iterations, seconds, decibel)


def test_the_front_is_what_nothing_reaches_sooner():
    slow = Run("twist", VOXELS, "float32", 9, (point(1, 1.0, 5.0), point(2, 9.0, 30.0)))
    fast = Run("admm", VOXELS, "float32", 9, (point(1, 2.0, 20.0), point(2, 4.0, 19.0)))
    assert [(each.solver, at.iterations) for each, at in pareto([slow, fast])] == [
        ("twist", 1),
        ("admm", 1),
        ("twist", 2),
    ]
    assert [row["pareto"] for row in table([slow, fast])] == [True, True, True, False]


def test_page_and_table_say_the_same(judge, tmp_path):
    run, exact = (measure(judge, "admm", VOXELS, ("fast",), dtype=kind) for kind in ("float32", "float64"))
    page = write_page([run, exact], None, tmp_path, "one LED", "acquire tradeoff", datetime.now(UTC))
    text = page.read_text()
    assert "data:image/png" in text
    assert f"{run.end.psnr_db:.2f}" in text
    with (tmp_path / "tradeoff.csv").open() as file:
        rows = list(csv.DictReader(file))
    both = [*run.points, *exact.points]
    assert [float(row["psnr_db"]) for row in rows] == [each.psnr_db for each in both]
    assert [row["dtype"] for row in rows] == ["float32"] * len(run.points) + ["float64"] * len(exact.points)
    assert json.loads((tmp_path / "tradeoff.json").read_text())["rows"][-1]["preset"] == "fast"
