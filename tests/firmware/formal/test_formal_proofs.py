"""The proofs hold for every clock of every run; if a line of the gateware is changed, one breaks."""

from __future__ import annotations

import pytest

from firmware.formal.engine import prove
from firmware.formal.mutants import MUTANTS, Mutant, broken_by
from firmware.formal.proofs import PROOFS


@pytest.mark.parametrize("name", PROOFS)
def test_the_proof_holds_and_is_not_vacuous(name: str) -> None:
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
