"""Representations of objects in an interpreter and in a notebook."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from acquire.calibrate.calibration import Calibration, Instrument, Measured
from acquire.config import load_rig, load_scene
from acquire.reconstruct import reconstruct
from acquire.showing import as_picture, as_table
from acquire.simulate import simulate
from acquire.store import Recording, open_recording, open_video, write_video


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("shown") / "run.zarr"
    rig = load_rig("rig-demo", {"geometry.stages": 8, "geometry.substeps": 2})
    simulate(rig, load_scene("scene-leds"), path, 60)
    return open_recording(path)


def test_a_recording_and_its_parts_show_their_content(recording: Recording, tmp_path: Path) -> None:
    assert repr(recording) == (
        f"<Recording: {recording}, GOOD, lines 0 to 59 of each arm, duration 0.0012 s at 50000 lines/s, "
        "geometry M = 8, S = 2, samples 8 pixels uint16, code prbs>"
    )
    assert (
        repr(recording.camera("b")) == f"<CameraStream: {recording}/b, lines 60 from 0 on, samples 8 uint16>"
    )
    assert re.fullmatch(
        r"<Segment: lines 10 to 49 of each arm, geometry M = 8, S = 2, sub steps 95 of 10000 ns, "
        r"samples uint16, \d+\.\d\d% usable>",
        repr(recording.cut(10, 40)),
    )
    assert "<td style='text-align:left'>M = 8, S = 2</td>" in recording._repr_html_()
    assert "data:image/png;base64," in recording._repr_html_()
    damaged = shutil.copytree(recording.path, tmp_path / "damaged.zarr")
    (damaged / "overview" / "a" / "c" / "0" / "0").unlink()
    assert "data:image" not in open_recording(damaged)._repr_html_()


def test_results_show_what_can_be_trusted(recording: Recording, tmp_path: Path) -> None:
    result = reconstruct(recording.cut(0, 60), 2, 2, preset="fast")
    trusted = range(len(result.video))[result.trusted]
    words = f"trusted frames {trusted.start} to {trusted.stop - 1}"
    assert repr(result).startswith(
        f"<Reconstruction: frames {len(result.video)} of 8 x 8 float32, {words}, solver"
    )
    assert "data:image/png;base64," in result._repr_html_()
    provenance = {"trusted": [trusted.start, trusted.stop]}
    write_video(
        tmp_path / "v.zarr",
        result.video,
        result.time_ns,
        pixel_size=2.0,
        frame_interval_ns=2e4,
        provenance=provenance,
        pixel_unit=None,
    )
    file = open_video(tmp_path / "v.zarr")
    shape = f"frames {len(result.video)} of 8 x 8 float32, 20 us each, pixel 2 x 2 fine pixels"
    assert repr(file) == f"<VideoFile: {shape}, {words}>"
    assert "data:image/png;base64," in file._repr_html_()
    (tmp_path / "v.zarr" / "0" / "c" / "0" / "0" / "0").write_bytes(b"damaged")
    assert "data:image" not in file._repr_html_()


def test_a_calibration_shows_what_is_known() -> None:
    instrument = Instrument(stages=8, substeps=2, substep_s=1e-5, layout="dual", cameras={})
    black = Measured(np.full((2, 8), 12.0), np.full((2, 8), 0.5))
    assert repr(black) == "<Measured: mean 12 ± 0.5 each, shape (2, 8)>"
    assert repr(Calibration(instrument)) == (
        "<Calibration: geometry M = 8, S = 2, dual, steps none yet, quantities none yet>"
    )


def test_foreign_text_is_escaped(recording: Recording) -> None:
    document = json.loads(json.dumps(recording.document))
    document["attributes"]["run_id"] = "<script>\x1b[31m"
    shown = Recording(recording.source, document)._repr_html_()
    assert "&lt;script&gt;\\x1b[31m" in shown
    assert "<b>&lt;i&gt;</b>" in as_table("<i>", {})


def test_pictures_that_cannot_be_drawn_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    assert as_picture(np.ones((3, 3)), "x").startswith("<img alt='x'")
    assert as_picture(np.full((3, 3), np.nan), "x") == ""
    assert as_picture(np.zeros((0, 3)), "x") == ""
    monkeypatch.setitem(sys.modules, "PIL", None)
    assert as_picture(np.ones((3, 3)), "x") == ""
