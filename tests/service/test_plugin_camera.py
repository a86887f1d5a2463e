"""Third-party drivers and a third-party codec under the real daemon: lines are recorded as delivered."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from live_daemon import Daemon, acquire
from packed import install
from waiting import until

from acquire.errors import UsageError
from acquire.store import open_recording, verify

EXTRAS = Path(__file__).parents[1] / "plugins" / "lab_extras"
READ = """
import sys, numpy, zarr
run = zarr.open_group(sys.argv[1], mode="r")
numpy.savez(sys.argv[2], a=run["a/lines"][:], b=run["b/lines"][:])
"""


def test_lines_of_a_driver_that_was_installed_are_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site"
    install(EXTRAS, site, tmp_path / "wheels")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")])))
    cameras = [f"cameras.{arm}.driver='ramp'" for arm in "ab"]
    slow = ("trigger.driver='slow-link'", "trigger.options={delay_s = 0.001}")
    codec = ("recording.codec='differences'", "recording.codec_options={level = 2}")
    daemon = Daemon(tmp_path, *cameras, "cameras.b.options={step = 2}", *slow, *codec)
    try:
        assert daemon("arm").code == 0, daemon.log.read_text()
        assert daemon("status", "--json").json["capacity"]["codec"] == "differences"
        assert daemon("start", "ramp.zarr", "--lines", 600).code == 0
        assert daemon("status", "--wait", "sealed").code == 0
        assert daemon("disarm").code == 0
    finally:
        daemon.close()
    recording = open_recording(tmp_path / "ramp.zarr")
    with pytest.raises(UsageError, match=r"codec 'differences' of lab-extras 0\.3, which cannot be used"):
        recording.cut(recording.first_line + 20, 100)
    assert verify(tmp_path / "ramp.zarr").intact
    shown = acquire("info", tmp_path / "ramp.zarr").out
    assert "codec differences of lab-extras 0.3" in shown
    # With it installed, any reader has the lines: here zarr-python, which knows nothing of ours.
    read = [sys.executable, "-c", READ, str(tmp_path / "ramp.zarr"), str(tmp_path / "lines.npz")]
    subprocess.run(read, check=True, timeout=120, cwd=tmp_path)
    lines = np.load(tmp_path / "lines.npz")
    for arm, step in (("a", 1), ("b", 2)):
        camera = recording.camera(arm)
        assert recording.attrs["config"]["cameras"][arm]["driver"] == "ramp"
        assert recording.attrs["config"]["cameras"][arm]["options"] == {"step": step}
        line = np.asarray(camera.line_number).astype(np.int64)[:, None]
        expected = (step * line + np.arange(8)) % 4095
        np.testing.assert_array_equal(lines[arm], expected)
    extras = {"distribution": "lab-extras", "version": "0.3"}
    used = [("camera driver", "ramp"), ("trigger driver", "slow-link"), ("codec", "differences")]
    assert recording.attrs["plugins"] == [{"kind": kind, "name": name, **extras} for kind, name in used]
    assert "camera driver ramp of lab-extras 0.3" in acquire("info", tmp_path / "ramp.zarr").out


BRITTLE = """
import zlib
from pathlib import Path
from typing import ClassVar
from acquire.store.variant import CodecVariant

class Brittle(CodecVariant):
    '''zlib, until a file appears.'''

    zarr_name: ClassVar[str] = "lab.brittle"
    file: str

    def encode(self, data):
        if Path(self.file).exists():
            raise RuntimeError("out of cheese")
        return zlib.compress(data, 1)

    def decode(self, data, size):
        return zlib.decompress(data)
"""


def test_a_codec_that_fails_ends_the_recording_with_what_is_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    about = tmp_path / "site" / "lab_brittle-1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: lab-brittle\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[acquire.codecs]\nbrittle = lab_brittle:Brittle\n")
    (tmp_path / "site" / "lab_brittle.py").write_text(BRITTLE)
    searched = (str(tmp_path / "site"), os.environ.get("PYTHONPATH"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, searched)))
    codec = ("recording.codec='brittle'", f"recording.codec_options={{file = '{tmp_path / 'fails'}'}}")
    daemon = Daemon(tmp_path, *codec, "recording.commit_s=0.2")
    try:
        assert daemon("arm").code == 0, daemon.log.read_text()
        assert daemon("start", "run.zarr").code == 0
        until(lambda: daemon("status", "--json").json["recording"]["committed_lines"] > 100)
        (tmp_path / "fails").touch()
        assert daemon("status", "--wait", "faulted").code == 0
        status = daemon("status", "--json").json
    finally:
        daemon.close()
    # Written or committed: whichever packs a chunk first after the file is there.
    doing = "(committing|writing lines of arm [ab])"
    why = f"codec failed while {doing}: codec 'brittle' of lab-brittle failed: RuntimeError: out of cheese"
    assert re.search(why, status["fault"])
    assert all(arm["ledger"]["balanced"] for arm in status["arms"].values())
    recording = open_recording(tmp_path / "run.zarr")
    assert (recording.state, recording.attrs["run_condition"]) == ("sealed", "ABORTED")
    assert recording.lines > 100
    assert verify(tmp_path / "run.zarr").intact
