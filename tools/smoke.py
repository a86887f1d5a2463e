"""Smoke test of an installed program: a user's first commands, in a directory of its own.

``python tools/smoke.py --program .venv/bin/acquire`` tries the core (a daemon that records the pattern of
two cameras, and a check of the recording), and with ``--lab`` also the extra `report` (a simulated recording,
and its video). Nothing is imported from the checkout. Ends with 1 if a command fails.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

RIG = """
name = "smoke"
[geometry]
stages = 8
substeps = 2
[trigger]
substep_ticks = 4500         # lines at 10 kHz
tag_every_lines = 64
[cameras.a]
driver = "pattern"
serial = "A"
[cameras.b]
driver = "pattern"
serial = "B"
[stream]
block_lines = 64
ring_slots = 1024
[recording]
directory = "."
[control]
socket = "c.sock"
"""
LIMIT_S = 600
"""Time limit for one command; some compile first."""
START_S = 120.0
END_S = 60
NO_DAEMON = 3
"""Exit code of commands without a daemon."""


class StepError(Exception):
    """A command failed; the text contains its output."""


@dataclass(frozen=True)
class Program:
    """An installed ``acquire``, run in ``home``."""

    path: Path
    home: Path

    def run(self, *words: str) -> str:
        """Return what a command prints. Raises StepError unless it ends with 0."""
        ended = self.ended(*words)
        if ended.returncode:
            raise StepError(f"ended with {ended.returncode}: {_last(ended.stdout + ended.stderr)}")
        return ended.stdout.strip()

    def ended(self, *words: str) -> subprocess.CompletedProcess[str]:
        try:
            return subprocess.run(
                [self.path, *words],
                cwd=self.home,
                env=own_environment(),
                capture_output=True,
                text=True,
                timeout=LIMIT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise StepError(f"has not ended within {LIMIT_S} s") from None
        except OSError as error:
            raise StepError(f"cannot be run: {error}") from None

    @contextmanager
    def daemon(self) -> Iterator[subprocess.Popen[str]]:
        """Start a daemon and wait until it listens."""
        with (self.home / "serve.log").open("w") as log:
            serving = subprocess.Popen(
                [self.path, "serve", "--config", "rig.toml"],
                cwd=self.home,
                env=own_environment(),
                stdout=log,
                stderr=log,
                text=True,
            )
        try:
            self._await(serving)
            yield serving
        finally:
            if serving.poll() is None:
                serving.kill()
                serving.wait()

    def _await(self, serving: subprocess.Popen[str]) -> None:
        deadline = time.monotonic() + START_S
        while (status := self.ended("status", "--socket", "c.sock")).returncode == NO_DAEMON:
            if serving.poll() is not None or time.monotonic() > deadline:
                raise StepError(f"serve does not listen: {_last((self.home / 'serve.log').read_text())}")
            time.sleep(0.2)
        if status.returncode:
            raise StepError(f"status: ended with {status.returncode}: {_last(status.stderr)}")


def own_environment() -> dict[str, str]:
    """Our environment without variables that lead to our modules, settings or daemon."""
    return {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "ACQUIRE_"))}


def _last(text: str, most_lines: int = 12) -> str:
    return "\n".join(text.strip().splitlines()[-most_lines:]) or "it printed nothing"


# ---- the steps


def _version(program: Program) -> str:
    return program.run("--version")


def _capture(program: Program) -> str:
    """A daemon records and is told to end, and its recording is complete."""
    (program.home / "rig.toml").write_text(RIG, encoding="utf-8")
    program.run("config", "check", "rig.toml")
    at = ("--socket", "c.sock")
    with program.daemon() as serving:
        program.run("arm", *at)
        program.run("start", "live.zarr", "--lines", "5000", *at)
        program.run("status", "--wait", "sealed", *at)
        program.run("disarm", *at)
        serving.terminate()
        if code := serving.wait(END_S):
            raise StepError(f"serve ended with {code}: {_last((program.home / 'serve.log').read_text())}")
    return _whole(program, "live.zarr", 5000)


def _simulate(program: Program) -> str:
    program.run("config", "check", "rig-demo")
    program.run("simulate", "scene-digits", "--out", "run.zarr", "--lines", "600")
    return _whole(program, "run.zarr", 600)


def _reconstruct(program: Program) -> str:
    words = ("--out", "video.zarr", "--lines", "140", "--preset", "fast", "--iterations", "10", "--nm", "3")
    said = program.run("reconstruct", "run.zarr", *words)
    return next(line for line in said.splitlines() if line.startswith("video"))


def _whole(program: Program, name: str, lines: int) -> str:
    said = program.run("verify", name)
    if "intact" not in said or f"{lines} lines" not in said:
        raise StepError(f"verify says of {lines} lines: {said}")
    return said


Steps = dict[str, Callable[[Program], str]]
"""Steps by name: each returns its result in words, or raises StepError."""
CORE: Steps = {"version": _version, "capture": _capture}
"""Steps that need only the program itself."""
LAB: Steps = {"simulate": _simulate, "reconstruct": _reconstruct}
"""Steps that need the extra `report`."""


def try_out(program: Path, steps: Steps) -> Iterator[tuple[str, str, bool]]:
    """Yield the name, result and success of each step; later steps are tried even after a failure."""
    with tempfile.TemporaryDirectory(prefix="acquire-smoke-") as home:
        for name, step in steps.items():
            try:
                yield name, step(Program(program, Path(home))), True
            except StepError as failure:
                yield name, str(failure), False


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--program", type=Path, required=True, help="the installed acquire")
    parser.add_argument("--lab", action="store_true", help="also try the extra `report`")
    options = parser.parse_args()
    good = True
    for name, result, passed in try_out(options.program.absolute(), CORE | (LAB if options.lab else {})):
        print(f"{'✓' if passed else '✗'} {name}: {result}", flush=True)
        good &= passed
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
