"""Mutation test of the proofs: the gateware with one line changed at a time, which must break a proof.

The changed source is imported next to the original, and proved in the same way. The property that the change
should break is checked first; the others only if it holds.
"""

from __future__ import annotations

import sys
from contextlib import contextmanager
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import TYPE_CHECKING

import firmware
from firmware.formal.engine import prove
from firmware.formal.mutant_list import MUTANTS, Mutant
from firmware.toolchain import ToolError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from types import CodeType, ModuleType

    from firmware.formal.harness import Proof

__all__ = ["MUTANTS", "Mutant", "broken_by"]

SOURCES = Path(firmware.__file__).parent


def broken_by(mutant: Mutant) -> tuple[str, ...]:
    """Return the properties that the changed gateware breaks; none means that the proof misses the change."""
    with _changed(mutant):
        proof: Proof = import_module("firmware.formal.proofs").PROOFS[mutant.proof]()
    verdict = prove(proof, first=True, only=(mutant.breaks,))
    if verdict.proved:
        verdict = prove(proof, first=True)
    return verdict.broken + verdict.uncovered


@contextmanager
def _changed(mutant: Mutant) -> Iterator[None]:
    """Within this context, modules of the gateware are imported from the changed source."""
    file = SOURCES / mutant.file
    text = file.read_text()
    if text.count(mutant.old) != 1:
        raise ToolError(f"{mutant.old!r} occurs {text.count(mutant.old)} times in {mutant.file}, not once")
    code = compile(text.replace(mutant.old, mutant.new), str(file), "exec", dont_inherit=True)
    # Import all of the gateware again: modules imported before would still refer to the original.
    finder = _Finder(f"{firmware.__name__}.{file.stem}", code)
    original = {name: sys.modules.pop(name) for name in list(sys.modules) if _is_ours(name)}
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in [name for name in sys.modules if _is_ours(name)]:
            del sys.modules[name]
        sys.modules.update(original)


def _is_ours(name: str) -> bool:
    return name.startswith(f"{firmware.__name__}.")


class _Finder(MetaPathFinder, Loader):
    """Finder that replaces the source of one module."""

    def __init__(self, name: str, code: CodeType) -> None:
        self._name, self._code = name, code

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname == self._name else None

    def exec_module(self, module: ModuleType) -> None:
        exec(self._code, vars(module))  # noqa: S102 - our own source, one line of it changed
