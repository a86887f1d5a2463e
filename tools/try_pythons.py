"""Try whether the packages install and run on every supported Python, in fresh environments.

::

    checkout ─▶ wheel, source distribution ─▶ for each Python, an environment of its own:
        the wheel alone            ─▶ the work of a capture host
        the wheel with [report]    ─▶ the README's first command
        the source distribution    ─▶ built by pip, and the same again, briefly

``python tools/try_pythons.py`` tries the versions of the classifiers in pyproject.toml, found on the path as
python3.11 and so on, or instead those given by ``--python PROGRAM`` (repeatable). Library versions are those
of tools/constraints.txt; if they do not suit a Python, this is reported and pip chooses. It needs a package
index, the package `build`, and about a gigabyte of disk for each environment, which is removed afterwards.
Ends with 1 if a Python is not found or something fails.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

from tools.packages import ROOT, Packages, faults, make
from tools.smoke import CORE, LAB, Steps, own_environment, try_out

CONSTRAINTS = ROOT / "tools/constraints.txt"
LIMIT_S = 1800
"""Time limit of one call of pip, which may compile if there is no wheel."""
QUESTION = "import sys; print(*sys.version_info[:3], sep='.')"
STAGES = (("core", "", CORE), ("report", "[report]", CORE | LAB))


class TrialError(Exception):
    """The trial cannot continue; the text gives the reason."""


@dataclass(frozen=True)
class Python:
    """A working interpreter."""

    program: str
    version: str


@dataclass
class Tally:
    """Print results as they come, and remember failures."""

    failed: list[str] = field(default_factory=list)

    def say(self, name: str, said: str, *, good: bool, seconds: float = 0.0) -> None:
        first, *more = said.strip().splitlines() or [""]
        took = f"  ({seconds:.0f} s)" if seconds >= 1 else ""
        print(f"{'✓' if good else '✗'} {name}: {first}{took}", *more, sep="\n    ", flush=True)
        if not good:
            self.failed.append(name)


def claimed() -> list[str]:
    """Versions in the classifiers, as in python3.11."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    last_words = [line.rpartition(" :: ")[2] for line in project["classifiers"]]
    return [f"python{word}" for word in last_words if re.fullmatch(r"3\.\d+", word)]


def ask(program: str) -> Python:
    """Version of a Python. Raises TrialError for a program that is no Python or does not run."""
    try:
        said = _run([program, "-c", QUESTION], 60)
    except OSError as error:
        raise TrialError(f"not found ({error.strerror}); name one with --python") from None
    except subprocess.TimeoutExpired:
        raise TrialError("does not answer") from None
    if said.returncode:
        why = (said.stderr.strip().splitlines() or ["it does not run"])[0]
        raise TrialError(f"{why}; name one with --python")
    return Python(program, said.stdout.strip())


def try_python(python: Python, made: Packages, tally: Tally) -> None:
    """Try one Python in two environments, one after the other."""
    name = f"Python {python.version}"
    for stage, extra, steps in STAGES:
        with tempfile.TemporaryDirectory(prefix="acquire-python-") as home:
            place = Path(home) / "env"
            try:
                _make_environment(python, place)
                install(f"{name}, {stage}: install the wheel", place, f"{made.wheel}{extra}", tally)
                _smoke(f"{name}, {stage}", place, steps, tally)
                if extra:
                    words = ("--no-deps", "--force-reinstall")
                    install(f"{name}, source: install", place, str(made.sdist), tally, *words)
                    _smoke(f"{name}, source", place, CORE, tally)
            except TrialError as broken:
                tally.say(f"{name}, {stage}", str(broken), good=False)


def _make_environment(python: Python, place: Path) -> None:
    _call([python.program, "-m", "venv", str(place)], "no environment can be made")


def install(name: str, place: Path, what: str, tally: Tally, *options: str) -> None:
    """Install with the constrained versions, or with those that pip chooses if they do not fit."""
    words = [str(place / "bin/python"), "-m", "pip", "install", "-q", "--disable-pip-version-check", *options]
    begun = time.monotonic()
    try:
        _call([*words, "-c", str(CONSTRAINTS), what], "pip")
        tally.say(name, "with the constraints", good=True, seconds=time.monotonic() - begun)
    except TrialError as broken:
        _call([*words, what], "pip, with the constraints and without")
        why = next((line for line in str(broken).splitlines() if "ERROR" in line), str(broken))
        tally.say(name, f"without the constraints, which do not suit it: {why}", good=True)


def _smoke(name: str, place: Path, steps: Steps, tally: Tally) -> None:
    begun = time.monotonic()
    for step, said, good in try_out(place / "bin/acquire", steps):
        tally.say(f"{name}: {step}", said, good=good, seconds=time.monotonic() - begun)
        begun = time.monotonic()


def _call(words: list[str], what: str) -> None:
    try:
        ended = _run(words, LIMIT_S)
    except subprocess.TimeoutExpired:
        raise TrialError(f"{what}: not ended within {LIMIT_S} s") from None
    if ended.returncode:
        lines = (ended.stderr.strip() or ended.stdout.strip()).splitlines()
        raise TrialError("\n".join([f"{what}: ended with {ended.returncode}", *lines[-8:]]))


def _run(words: list[str], limit_s: float) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        words, capture_output=True, text=True, timeout=limit_s, check=False, env=own_environment()
    )


def try_all(programs: list[str], tally: Tally, made: Packages) -> None:
    for text in faults(made):
        tally.say("packages", text, good=False)
    for program in programs:
        try:
            python = ask(program)
        except TrialError as broken:
            tally.say(program, str(broken), good=False)
            continue
        try_python(python, made, tally)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--python", action="append", metavar="PROGRAM", help="Python to try; repeatable")
    programs = parser.parse_args().python or claimed()
    tally = Tally()
    with tempfile.TemporaryDirectory(prefix="acquire-packages-") as home:
        try:
            made = make(Path(home))
        except subprocess.CalledProcessError as error:
            print(f"✗ packages cannot be made:\n{error.stdout.decode(errors='replace')}")
            return 1
        tally.say("packages", f"{made.sdist.name}, {made.wheel.name}", good=True)
        try_all(programs, tally, made)
    print(f"{len(tally.failed)} failed: {'; '.join(tally.failed)}" if tally.failed else "all went well")
    return 1 if tally.failed else 0


if __name__ == "__main__":
    sys.exit(main())
