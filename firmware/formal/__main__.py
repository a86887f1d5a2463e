"""Prove the gateware: ``python -m firmware.formal [NAME ...] [--mutants] [--json]``.

Exit code 0: everything proved, and every mutant detected; 1: not; 2: a tool is missing or failed.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time

from rich.console import Console
from rich.table import Table

from firmware.formal.engine import prove
from firmware.formal.mutants import MUTANTS, broken_by
from firmware.formal.proofs import PROOFS
from firmware.toolchain import LOG, ToolError, log_progress

OUTPUT = Console()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m firmware.formal", description="Prove the gateware.")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"a proof to carry out, by default all: {', '.join(PROOFS)}"
    )
    parser.add_argument(
        "--mutants", action="store_true", help="also break the gateware, and expect each change to be noticed"
    )
    parser.add_argument("--first", action="store_true", help="stop a proof at the first property broken")
    parser.add_argument("--json", action="store_true", help="verdicts as JSON")
    chosen = parser.parse_args()
    if unknown := set(chosen.names) - set(PROOFS):
        parser.error(f"no proof {', '.join(sorted(unknown))}; there are {', '.join(PROOFS)}")
    names = chosen.names or list(PROOFS)
    log_progress()
    try:
        good = _as_json(names, chosen.first) if chosen.json else _as_table(names, chosen.first)
        return 0 if good and (not chosen.mutants or _mutants(names)) else 1
    except ToolError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return 2


def _as_json(names: list[str], first: bool) -> bool:
    verdicts = {name: prove(PROOFS[name](), first) for name in names}
    print(json.dumps({name: dataclasses.asdict(verdict) for name, verdict in verdicts.items()}))  # noqa: T201
    return all(verdict.proved for verdict in verdicts.values())


def _as_table(names: list[str], first: bool) -> bool:
    table = Table("proof", "claims", "lemmas", "covers", "verdict", "s", title="for any length of run")
    good = True
    for name in names:
        proof = PROOFS[name]()
        verdict = prove(proof, first)
        good &= verdict.proved
        result = "proved" if verdict.proved else "BROKEN: " + ", ".join(verdict.broken + verdict.uncovered)
        sizes = (len(proof.claims), proof.lemmas, len(proof.covers))
        table.add_row(name, *map(str, sizes), result, f"{verdict.seconds:.1f}")
    OUTPUT.print(table)
    return good


def _mutants(names: list[str]) -> bool:
    table = Table("mutant", "file", "in place of", "is", "breaks", "s", title="mutants")
    caught = True
    for mutant in (mutant for mutant in MUTANTS if mutant.proof in names):
        began = time.monotonic()
        LOG.info("mutant %r", mutant.name)
        broken = broken_by(mutant)
        caught &= bool(broken)
        change = (mutant.name, mutant.file, mutant.old, mutant.new)
        table.add_row(*change, ", ".join(broken) or "NOTHING", f"{time.monotonic() - began:.1f}")
    OUTPUT.print(table)
    return caught


if __name__ == "__main__":
    sys.exit(main())
