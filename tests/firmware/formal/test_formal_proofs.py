"""The gateware keeps its promises in every clock of every run; with a line of it changed, a proof breaks."""

from __future__ import annotations

import pytest

from firmware.formal.engine import prove
from firmware.formal.mutants import MUTANTS, Mutant, broken_by
from firmware.formal.proofs import PROOFS


@pytest.mark.parametrize("name", PROOFS)
def test_is_proved_and_says_something(name: str) -> None:
    proof = PROOFS[name]()
    verdict = prove(proof)
    assert verdict.broken == ()
    assert verdict.uncovered == (), "what should be able to happen cannot: the proof assumes too much"
    assert proof.claims
    assert proof.covers


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_changed_line_is_noticed(mutant: Mutant) -> None:
    assert broken_by(mutant), f"{mutant.proof} is blind to {mutant.new!r} in {mutant.file}"


def test_every_proof_has_a_mutant_that_breaks_it() -> None:
    assert {mutant.proof for mutant in MUTANTS} == set(PROOFS)
