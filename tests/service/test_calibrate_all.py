"""The guided calibration on a running daemon: the scene is changed at its prompts."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from live_daemon import COMMAND, Daemon, acquire

from acquire.calibrate import calibration_of, open_calibration
from acquire.client import SEALED
from acquire.store import open_recording

M, S = 16, 3
N = M * S
EFFECTS = """
[[effects]]
kind = "misregistration"
rows = 1.4
columns = -0.8
turn_deg = 0.5
[[effects]]
kind = "beam_splitter"
part_a = 0.47
[[effects]]
kind = "prnu"
prnu = 0.01
[[effects]]
kind = "shot_noise"
[[effects]]
kind = "read_noise"
sigma_e = 20.0
[[effects]]
kind = "column_offsets"
sigma_dn = 2.0
"""
WHITE = """
kind = "leds"
[[leds]]
name = "all"
shape = "square"
row = 0.5
column = 0.5
size = 1.0
drive = { waveform = "constant", level = 0.5 }
"""
DOT = """
[[leds]]
name = "{number}"
shape = "square"
row = {row}
column = {column}
size = {size}
drive = {{ waveform = "constant" }}
"""
SETTINGS = (
    f"geometry.stages={M}",
    f"geometry.substeps={S}",
    "trigger.substep_ticks=9000",
    *(f"cameras.{arm}.black_level_dn=20.0" for arm in "ab"),
    *(f"cameras.{arm}.responsivity_dn=10.0" for arm in "ab"),
)


def target() -> str:
    """Bright squares of 2 to 6 fine pixels, anywhere."""
    rng = np.random.default_rng(1)
    dots = [
        DOT.format(number=k, row=rng.uniform(0.12, 0.88), column=rng.uniform(0.12, 0.88), size=size / N)
        for k, size in enumerate(rng.uniform(2, 6, 24))
    ]
    return 'kind = "leds"' + "".join(dots)


def scene_before(directory: Path) -> tuple[Callable[[str], None], tuple[str, ...]]:
    """Return what puts a scene before the cameras, now a white one, and the settings of a rig that sees it.

    The rig names a calibration that is not there yet.
    """

    def put(scene: str) -> None:
        fresh = directory / "fresh.toml"
        fresh.write_text(scene + EFFECTS)
        fresh.replace(directory / "scene.toml")

    put(WHITE)
    places = f"simulation.scene='{directory}/scene.toml'", f"calibration='{directory}/cal.zarr'"
    return put, (*SETTINGS, *places)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[tuple[Daemon, Callable[[str], None]]]:
    """A daemon, and a function that puts a scene in front of its cameras."""

    put, settings = scene_before(tmp_path)
    daemon = Daemon(tmp_path, *settings)
    try:
        yield daemon, put
    finally:
        daemon.close()


def test_dark_flat_target_by_hand(bench: tuple[Daemon, Callable[[str], None]], tmp_path: Path) -> None:
    daemon, put = bench
    words = ["calibrate", "all", "--out", str(tmp_path / "cal.zarr"), "--lines", "384"]
    guided = subprocess.Popen(
        [*COMMAND, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"ACQUIRE_SOCKET": str(daemon.socket)},
    )
    assert guided.stdin is not None
    assert guided.stderr is not None
    said = ""
    for line in guided.stderr:
        said += line
        if "Put a target in" in line:
            put(target())
        if "press Enter" in line:
            guided.stdin.write("\n")
            guided.stdin.flush()
    out = guided.communicate(timeout=300)[0]
    assert guided.returncode == 0, said
    assert "DN per electron" in out
    assert "turn 90" in out
    known = open_calibration(tmp_path / "cal.zarr")
    assert list(known.steps) == ["dark", "flat", "transfer", "orientation", "align"]
    # these dots show no blur, which does not stop the sequence
    missing = known.steps["align"]["warnings"][-1]
    assert missing.startswith("the target does not show the optics' blur: ")
    assert "acquire calibrate sheet draws a target that shows it" in missing
    assert missing in " ".join(said.split())
    assert known.alignment is not None
    assert known.alignment.alignment.rows == pytest.approx(1.4, abs=0.15)
    assert known.alignment.alignment.columns == pytest.approx(-0.8, abs=0.15)
    balance = known.value("balance")
    assert balance is not None
    assert balance[0] / 2 == pytest.approx(0.47, abs=0.01)
    taken = [open_recording(path) for path in sorted((tmp_path / "calibration-recordings").iterdir())]
    assert [each.attrs["code"]["kind"] for each in taken] == ["constant", "constant", "prbs"]
    with daemon.client() as client:
        assert client.status().state == "idle"
    _handed_on(daemon, tmp_path)


def _handed_on(daemon: Daemon, home: Path) -> None:
    """From then on every recording gets a copy, unless the user declines."""
    with daemon.client() as client:
        assert client.arm(code="steady").light == "steady"
        assert client.disarm().light is None
        armed = client.arm()
        calibration = armed.calibration
        assert armed.light == "rig"
        assert calibration is not None
        assert calibration.carried
        client.start(home / "run.zarr", lines=64)
        client.wait(SEALED, timeout_s=120)
        client.disarm()
        assert client.arm(calibration="none").calibration is None
        client.start(home / "without.zarr", lines=64)
        client.wait(SEALED, timeout_s=120)
        client.disarm()
    carried = calibration_of(open_recording(home / "run.zarr"))
    assert carried is not None
    assert carried.alignment == open_calibration(home / "cal.zarr").alignment
    assert calibration_of(open_recording(home / "without.zarr")) is None
    assert daemon("verify", home / "run.zarr").code == 0


def test_failures_leave_the_instrument_as_it_was(
    bench: tuple[Daemon, Callable[[str], None]], tmp_path: Path
) -> None:
    """A flat without a dark is refused, and without a terminal for Enter nothing is recorded."""
    daemon, _ = bench
    cal = tmp_path / "c.zarr"
    with daemon.client() as client:
        armed = daemon("arm")
        assert "recordings carry no calibration: none" in armed.err
        assert client.status().calibration.path == tmp_path / "cal.zarr"
        client.start(tmp_path / "bare.zarr", lines=64)
        client.wait(SEALED, timeout_s=120)
        assert "named in the rig file, did not exist" in daemon("info", "bare.zarr").out
        answer = daemon("calibrate", "all", "--only", "flat", "--yes", "--lines", 64, "--out", cal)
        assert answer.code == 2
        assert "offsets of the columns first" in answer.err
        assert client.status().state == "armed"
        before = client.status().run_id
        answer = daemon("calibrate", "all", "--out", cal)
        assert answer.code == 4
        assert "Enter cannot be pressed" in answer.err
        assert client.status().run_id == before
    assert not cal.exists()
    assert acquire("calibrate", "all", "--only", "lunch", "--out", cal).code == 2
