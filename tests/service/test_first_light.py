"""FIRST_LIGHT.md: its commands are carried out, in their order, on the instrument to practise on."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from live_daemon import COMMAND

from acquire.calibrate import calibration_of, open_calibration
from acquire.config import builtin_directory
from acquire.lines import LineFlag
from acquire.store import open_recording

TEXT = (Path(__file__).parents[2] / "acquire" / "calibrate" / "FIRST_LIGHT.md").read_text(encoding="utf-8")
STEPS = re.findall(r"In front of the lenses: `([\w-]+)`|```sh\n(.*?)```", TEXT, re.DOTALL)
SMALLER = {
    "stages = 64": "stages = 48",
    "responsivity_dn = 6.0": "responsivity_dn = 8.0",
    'codec = "lz4"': 'codec = "none"',
}
"""The same instrument with fewer pixels, as bright. Still fewer would not see whole squares of the sheet."""
QUICKER = {
    "acquire paper fig9 ": "acquire paper fig9 --preset fast --budget 5 ",
    "calibrate delay ": "calibrate delay --lines 4096 ",
    "--seconds 2": "--seconds 0.5",
}
ENTER = """
import json
from pathlib import Path
found = json.loads(Path("cal.zarr/zarr.json").read_text())["attributes"]["steps"]["delay"]["rig"]
table, lines = "", []
for line in Path("rig.toml").read_text().splitlines():
    table = line.strip("[]") if line.startswith("[") else table
    key = f"{table}.{line.split(' ')[0]}".removeprefix("trigger.")
    lines.append(f"{line.split(' ')[0]} = {found[key]}" if key in found else line)
Path("rig.toml").write_text("\\n".join(lines))
"""
"""The step of a person: the reported delays go into the rig file."""
DELAYS = (2.9e-6, 2.4e-6)
"""Of the practice instrument: the light behind cameras A and B."""


def script() -> str:
    """All of the document's commands, and what is done by hand between them."""
    said = ["set -e", "trap 'kill $(jobs -p); wait' EXIT"]
    for scene, commands in STEPS:
        if scene:
            said.append(f"cp '{builtin_directory()}/{scene}.toml' scene-practice.toml")
            continue
        block = commands
        for words, others in QUICKER.items():
            block = block.replace(words, others)
        said.append(block)
        if "calibrate delay" in block:
            said += ["kill %1; wait %1", f"'{sys.executable}' enter.py", "acquire serve --config rig.toml &"]
    return "\n".join(said)


@pytest.mark.timeout(600)
def test_every_command_of_the_document_works(tmp_path: Path) -> None:
    rig = (builtin_directory() / "rig-practice.toml").read_text(encoding="utf-8")
    for words, others in SMALLER.items():
        assert words in rig
        rig = rig.replace(words, others)
    (tmp_path / "rig.toml").write_text(rig, encoding="utf-8")
    (tmp_path / "enter.py").write_text(ENTER, encoding="utf-8")
    place = {"ACQUIRE_SOCKET": str(tmp_path / "c.sock"), "XDG_RUNTIME_DIR": str(tmp_path)}
    path = f"{Path(COMMAND[0]).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script()],
        cwd=tmp_path,
        env=os.environ | place | {"PATH": path},
        capture_output=True,
        text=True,
        timeout=590,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for phrase in ("the self-test passed", "turn 90", "DN per electron", "250 ms lit, 250 ms dark"):
        assert phrase in done.stdout, phrase
    known = open_calibration(tmp_path / "cal.zarr")
    done_steps = ["delay", "dark", "linearity", "transfer", "flat", "orientation", "align", "psf"]
    assert list(known.steps) == done_steps
    late = known.quantities["light_late_ticks"]
    assert late.value == pytest.approx([each * 90e6 for each in DELAYS], abs=5 * late.uncertainty.max())
    recording = open_recording(tmp_path / "lamps.zarr")
    assert calibration_of(recording) is not None
    assert recording.attrs["run_condition"] == "GOOD"
    assert not (recording.arms["a"].read("flags", 0, recording.lines) & LineFlag.CODE_CONTRADICTED).any()
    facts = json.loads((tmp_path / "fig9" / "summary.json").read_text(encoding="utf-8"))
    rows = {row["what"]: row["ours"] for row in facts["figures"][0]["rows"]}
    assert {"x: 5000 Hz", "triangle: 2500 Hz", "circle: 1000 Hz", "equals: constant"} <= rows.keys()
