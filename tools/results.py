"""Kept results of benchmarks: one line of JSON per run, and tables made from them.

``--record`` of a benchmark appends its run to tools/results.jsonl: the command, date, commit, machine and its
load before the run, and a row of figures per case. ``python tools/results.py`` lists the runs, ``--table
NAME`` prints the newest complete run of a benchmark as Markdown, ``--run NUMBER`` any other.

Between ``<!-- results of COMMAND -->`` and ``<!-- end of results -->`` in a document, ``--write`` inserts the
newest complete run of that command, which is given without ``--record``. A test notices outdated tables.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

import acquire
from acquire.cores import usable_cores

ROOT = Path(__file__).parents[1]
FILE = ROOT / "tools/results.jsonl"
DOCUMENTS = tuple(
    ROOT / name for name in ("README.md", "tools/MEASURED.md", "tools/MEASURED_RECONSTRUCTION.md")
)
_PLACE = re.compile(r"(<!-- results of (.+?) -->\n).*?(<!-- end of results -->)", re.DOTALL)
Figure = float | int | str | None


@dataclass(frozen=True)
class Machine:
    """Properties of the machine on which figures depend, without its name."""

    cpu: str
    cores: int
    memory_gb: float
    load_before: float
    kernel: str
    python: str
    numpy: str

    @classmethod
    def here(cls) -> Machine:
        """This machine, with the load of the last minute before the benchmark adds its own."""
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        return cls(
            cpu=cpu_model(),
            cores=usable_cores(),
            memory_gb=round(memory / 1e9, 1),
            load_before=round(os.getloadavg()[0], 2),
            kernel=platform.release(),
            python=platform.python_version(),
            numpy=np.__version__,
        )


@dataclass
class Run:
    """One run of a benchmark: a row per case, named figures with their units in the names.

    ``commit`` ends with + if the tree differed from it. ``whole``: the run was completed.
    """

    benchmark: str
    command: str
    date: str
    commit: str
    version: str
    machine: Machine
    rows: list[dict[str, Figure]] = field(default_factory=list)
    whole: bool = False

    def add(self, case: str, **figures: Any) -> None:
        """Add a case; figures that are not finite are recorded as absent."""
        self.rows.append({"case": case, **{name: _plain(value) for name, value in figures.items()}})


def add_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--record", action="store_true", help=f"append the results to tools/{FILE.name}")


@contextmanager
def recorded(benchmark: str, *, keep: bool, file: Path = FILE) -> Iterator[Run]:
    """A run to add figures to. It is appended to the file when it ends, also if it ends early."""
    run = Run(
        benchmark=benchmark,
        command=_command(sys.argv),
        date=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        commit=commit(),
        version=acquire.__version__,
        machine=Machine.here(),
    )
    try:
        yield run
        run.whole = True
    finally:
        if keep and run.rows:
            with file.open("a", encoding="utf-8") as out:
                out.write(json.dumps(asdict(run), ensure_ascii=False) + "\n")


def best_ms(work: Callable[[], object]) -> float:
    """Return the shortest of five times, after a first that compiles; neighbours only make them longer."""
    work()
    times = []
    for _ in range(5):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return min(times) * 1e3


def cpu_model(path: Path = Path("/proc/cpuinfo")) -> str:
    """CPU model as reported by the kernel, or the architecture."""
    lines = (line.partition(":") for line in path.read_text(encoding="utf-8").splitlines())
    return next(
        (value.strip() for name, _, value in lines if name.strip() == "model name"), platform.machine()
    )


def commit(root: Path = ROOT) -> str:
    """Commit of the measured tree, ignoring changes of the results; "unknown" outside a checkout."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=root, check=True, capture_output=True, text=True, timeout=60
        ).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", f":!tools/{FILE.name}")
        return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _command(words: list[str]) -> str:
    """The command as given, without paths on this machine."""
    program = Path(words[0]).absolute()
    name = program.relative_to(ROOT) if program.is_relative_to(ROOT) else Path(program.name)
    return shlex.join(["python", str(name), *("DIR" if word.startswith("/") else word for word in words[1:])])


def _plain(value: Any) -> Figure:
    """Convert numbers of any library to those of JSON."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    if value is None or isinstance(value, (int, str)):
        return value
    raise TypeError(f"{value!r} is no figure; possible: a number, a text, None")


# ---- reading runs and making tables


def read(file: Path = FILE) -> list[Run]:
    """All runs, the oldest first. Raises ValueError for a line that is not a run."""
    runs = []
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines() if file.exists() else (), 1):
        try:
            facts = json.loads(line)
            runs.append(Run(**{**facts, "machine": Machine(**facts["machine"])}))
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{file.name}, line {number}: not a run of a benchmark: {error}") from None
    return runs


def table(run: Run) -> str:
    """Markdown: the origin of the figures, then a table for each group of cases with the same figures."""
    parts = [list(rows) for _, rows in groupby(run.rows, key=tuple)]
    return "\n\n".join([_origin(run), *map(_part, parts)])


def _part(rows: list[dict[str, Figure]]) -> str:
    """Table with a row per case, and a column per figure that any of them has."""
    columns = [name for name in rows[0] if any(row[name] is not None for row in rows)]
    shown = [[_shown(row[name]) for name in columns] for row in rows]
    lines = [[_heading(name) for name in columns], ["---"] * len(columns), *shown]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _origin(run: Run) -> str:
    on = run.machine
    cut = "" if run.whole else "; cut short"
    return (
        f"(`{run.command}`,\n{run.date[:10]}, commit {run.commit}; {on.cpu}, {on.cores} cores, "
        f"load {on.load_before:g} before; Python {on.python}, NumPy {on.numpy}{cut})"
    )


UNITS = {
    "mb_s": "MB/s",
    "gb_s": "GB/s",
    "s_per_gb": "s per GB",
    "mb": "MB",
    "us": "µs",
    "ms": "ms",
    "s": "s",
    "db": "dB",
    "hz": "Hz",
    "percent": "%",
}
"""Ending of a figure's name → its unit. Longer endings come first: gb_s is not in seconds."""


def _heading(name: str) -> str:
    """Heading of a figure: its words, and the unit in brackets: write_mb_s → write (MB/s)."""
    for ending, unit in UNITS.items():
        if name == ending:
            return unit
        if name.endswith(f"_{ending}"):
            return f"{name.removesuffix(f'_{ending}').replace('_', ' ')} ({unit})"
    return name.replace("_", " ")


def _shown(value: Figure) -> str:
    """Format with three digits, without an exponent if readable."""
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value).replace("|", "\\|")
    size = abs(value)
    if size >= 100:
        return f"{value:.0f}"
    return f"{value:.1f}" if size >= 10 else f"{value:.2f}" if size >= 1 else f"{value:.3g}"


def choose(runs: list[Run], benchmark: str | None, number: int | None) -> Run:
    """The run with a number, or a benchmark's newest complete run. Raises ValueError listing all."""
    if number is not None:
        if not 1 <= number <= len(runs):
            raise ValueError(f"run {number}: there are {len(runs)}")
        return runs[number - 1]
    found = [run for run in runs if run.benchmark == benchmark and run.whole]
    if not found:
        there = ", ".join(sorted({run.benchmark for run in runs})) or "none yet"
        raise ValueError(
            f"no whole run of {benchmark}; there are: {there}; python tools/{benchmark}.py --record"
        )
    return found[-1]


def with_tables(text: str, runs: list[Run]) -> str:
    """The document with its tables updated. Raises ValueError for a command without a complete run."""

    def filled(place: re.Match[str]) -> str:
        before, command, after = place.groups()
        found = [run for run in runs if run.whole and run.command.replace(" --record", "") == command]
        if not found:
            raise ValueError(f"no whole run of {command!r} is kept; run it with --record")
        return f"{before}{table(found[-1])}\n{after}"

    return _PLACE.sub(filled, text)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--table", metavar="NAME", help="print this benchmark's newest run: bench_store, …")
    parser.add_argument("--run", type=int, metavar="NUMBER", help="print this run of the list instead")
    parser.add_argument("--write", action="store_true", help="update the tables of the documents")
    parser.add_argument("--file", type=Path, default=FILE, help=f"file of runs, instead of tools/{FILE.name}")
    options = parser.parse_args()
    try:
        runs = read(options.file)
        if options.table or options.run is not None:
            print(table(choose(runs, options.table, options.run)))
            return 0
        if options.write:
            texts = [with_tables(path.read_text(encoding="utf-8"), runs) for path in DOCUMENTS]
            for path, text in zip(DOCUMENTS, texts, strict=True):
                path.write_text(text, encoding="utf-8")
            return 0
    except ValueError as error:
        print(f"results: {error}", file=sys.stderr)
        return 2
    for number, run in enumerate(runs, 1):
        print(f"{number:3}  {run.benchmark:18}{len(run.rows):4} rows  {_origin(run)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
