"""Does a proof notice? The gateware, one line changed at a time, each of which must break one.

The change is made to a copy of the source, which is then proved as it stands by an interpreter of its own.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import firmware
from firmware.toolchain import ToolError

SOURCES = Path(firmware.__file__).parent
TIME_LIMIT_S = 100.0


@dataclass(frozen=True, slots=True)
class Mutant:
    name: str
    proof: str
    file: str
    old: str
    """Part of one line of ``file``, there exactly once."""
    new: str


MUTANTS = (
    Mutant(
        "a clock too long",
        "timing",
        "timing.py",
        "left.eq(self.substep_clocks - 1)",
        "left.eq(self.substep_clocks)",
    ),
    Mutant(
        "jitter at a stop", "timing", "timing.py", "m.Elif(left != 0)", "m.Elif((left != 0) & ~self.stop)"
    ),
    Mutant(
        "S + 1 code bits",
        "timing",
        "timing.py",
        "self.place + 1 == self.substeps",
        "self.place == self.substeps",
    ),
    Mutant("stop forgotten", "timing", "timing.py", "(stopping | self.stop |", "(self.stop |"),
    Mutant("light late", "timing", "timing.py", "(left == self.lead)", "(left + 1 == self.lead)"),
    Mutant("start without the lead", "timing", "timing.py", "left.eq(self.lead)", "left.eq(0)"),
    Mutant("a line too few", "timing", "timing.py", "self.line_number + 2", "self.line_number + 3"),
    Mutant("pulse late", "pulses", "pulse.py", "wait.eq(self.delay - 1)", "wait.eq(self.delay)"),
    Mutant("a phase twice", "transfer", "phases.py", "more.eq(more - 1)", "more.eq(more)"),
    Mutant("never backwards", "transfer", "phases.py", "Mux(self.backwards,", "Mux(0 & self.backwards,"),
    Mutant("pulse long", "pulses", "pulse.py", "active.eq(hold != 1)", "active.eq(hold != 0)"),
    Mutant(
        "below the camera's minimum",
        "settings",
        "checks.py",
        "distance < value(r.CAMERA_MIN_PERIOD)",
        "distance + 1 < value(r.CAMERA_MIN_PERIOD)",
    ),
    Mutant("lead of a sub-step", "settings", "checks.py", '"lead") >= clocks', '"lead") > clocks'),
    Mutant("pulse into the next", "settings", "checks.py", "(end >= distance)", "(end > distance)"),
    Mutant("four clocks", "settings", "checks.py", "clocks < SUBSTEP", "clocks + 1 < SUBSTEP"),
    Mutant("edge beats STOP", "runs", "commands.py", "self.start.eq(0)", "self.self_test.eq(0)"),
    Mutant("STOP after the end", "runs", "commands.py", "runs & ~over)", "runs)"),
    Mutant("start before the code", "runs", "commands.py", "self.edge & (settling == 0)", "self.edge"),
    Mutant("START without a clock", "runs", "commands.py", "armed & self.clock_locked)", "armed)"),
    Mutant("bad configuration armed", "runs", "commands.py", "config_error == 0)", "config_error <= 1)"),
    Mutant("STOP without effect", "runs", "commands.py", "self.stop.eq(1)", "self.stop.eq(0)"),
    Mutant("lost in silence", "tags", "tagger.py", "self.lost.eq(self.lost + 1)", "self.lost.eq(self.lost)"),
    Mutant("event forgotten", "tags", "tagger.py", "pending.eq(self.events)", "pending.eq(0)"),
    Mutant("pushed out of the queue", "tags", "fifo.py", "~self.output.valid |", "self.output.valid |"),
    Mutant("next run over an untold end", "wiring", "top.py", " | self.tagger.telling", ""),
    Mutant("edge that was not asked for", "wiring", "top.py", "self.arm.edge & enabled", "self.arm.edge"),
    Mutant(
        "another budget", "wiring", "top.py", "lines.eq(file.value(r.LINE_", "lines.eq(1 + file.value(r.LINE_"
    ),
    Mutant("window a clock longer", "wiring", "light.py", "clock < self.window", "clock <= self.window"),
    Mutant("light after the end", "wiring", "light.py", "self.code_bit & ~self.ending", "self.code_bit"),
    Mutant("written in a run", "requests", "host.py", "(self._in_code | self.guarded)", "(self._in_code)"),
    Mutant("hidden loss", "tags", "tagger.py", "hidden.eq(self.full)", "hidden.eq(0)"),
)


def broken_by(mutant: Mutant) -> tuple[str, ...]:
    """Properties that the changed gateware breaks: at least one, or the proof is blind to the change."""
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / SOURCES.name
        shutil.copytree(SOURCES, copy, ignore=shutil.ignore_patterns("__pycache__"))
        source = copy / mutant.file
        text = source.read_text()
        if text.count(mutant.old) != 1:
            raise ToolError(f"{mutant.old!r} is {text.count(mutant.old)} times in {mutant.file}, not once")
        source.write_text(text.replace(mutant.old, mutant.new))
        return _prove(mutant.proof, Path(scratch))


def _prove(proof: str, folder: Path) -> tuple[str, ...]:
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "firmware.formal", "--json", "--first", proof],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=TIME_LIMIT_S,
        check=False,
    )
    if done.returncode not in {0, 1} or not done.stdout:
        raise ToolError(f"the mutant was not judged:\n{done.stderr[-2000:]}")
    verdicts = json.loads(done.stdout)
    return tuple(verdicts[proof]["broken"] + verdicts[proof]["uncovered"])
