"""Comparison of a segment's description with its lines, in words: what is wrong, and how certain that is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.cores import limit_threads
from acquire.recon.balance import balance_of
from acquire.recon.hypotheses import Hypothesis, LineModel, Turn
from acquire.recon.sanity import Suspicion, black_level_off, dark, suspicions, unusable
from acquire.recon.search import Inquiry, Standing, WeighedHypothesis, advantage, inquire

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.lines import Segment

FEWEST_DIAGNOSED, FEWEST_STAGES = 24, 4
"""Fewest lines and stages for which anything is claimed."""
TURNED = {
    Turn(pixels=True): "arm B is mirrored: its pixels are in the other order, or arm A's rows are",
    Turn(rows=True): "arm A is mirrored: its pixels are in the other order, or arm B's rows are",
    Turn(rows=True, pixels=True): "the arms are swapped, or one of them is turned by 180 degrees",
}
UNEXPLAINED = "the code does not explain the lines: another seed, another run's code, or far off"


@dataclass(frozen=True, slots=True)
class HypothesisRow:
    """One hypothesis of the table.

    ``likelier``: log likelihood over that of the description, also in standard ``errors``; ``agreement`` of
    the arms relative to that under random codes.
    """

    name: str
    likelier: float
    errors: float
    agreement: float


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """``standing`` of the description, with a ``sentence``; ``hypothesis`` if one is named or right.

    ``alternative`` is another hypothesis that cannot be distinguished from it.
    """

    standing: Standing
    sentence: str
    rows: tuple[HypothesisRow, ...] = ()
    suspicions: tuple[Suspicion, ...] = ()
    hypothesis: Hypothesis | None = None
    alternative: Hypothesis | None = None

    @property
    def wrong(self) -> bool:
        """Whether something is wrong for certain."""
        return self.standing in (Standing.NAMED, Standing.UNEXPLAINED) or bool(self.suspicions)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is wrong, in sentences for the user."""
        named = (self.sentence,) if self.standing in (Standing.NAMED, Standing.UNEXPLAINED) else ()
        return (*named, *(each.words for each in self.suspicions))

    def to_dict(self) -> dict[str, Any]:
        """Return the diagnosis as JSON, as ``acquire diagnose --json`` prints it."""
        return {
            "standing": str(self.standing),
            "sentence": self.sentence,
            "suspicions": [{"kind": each.kind, "words": each.words} for each in self.suspicions],
            "hypotheses": [
                {
                    "name": row.name,
                    "log_likelihood": round(row.likelier, 1),
                    "standard_errors": round(row.errors, 2),
                    "agreement": round(row.agreement, 2),
                }
                for row in self.rows
            ],
        }


def diagnose(segment: Segment, bits: Callable[[int, int], NDArray[np.uint8]] | None = None) -> Diagnosis:
    """Compare the code, delays, orientation, S, levels and gains of a segment with its lines.

    ``bits(start, length)`` returns the code from the segment's first bit on, also beyond the segment.
    """
    nothing = [*unusable(segment), *dark(segment)]
    if nothing:
        return Diagnosis(Standing.UNCLEAR, "the lines cannot be compared with their code", (), tuple(nothing))
    if segment.geometry.lines < FEWEST_DIAGNOSED or segment.geometry.stages < FEWEST_STAGES:
        few = f"{segment.geometry.lines} lines of {segment.geometry.stages} pixels are too few to tell"
        return Diagnosis(Standing.UNCLEAR, few)
    # The matrices are small: more threads would wait for each other.
    with limit_threads(1):
        found = _diagnosed(LineModel(segment, bits))
    unequal = []
    balance = balance_of([segment])
    if balance is not None and balance.clear:
        words = f"{balance.words}: the gains or the beam splitter differ"
        unequal.append(Suspicion("gain_ratio", words))
    return replace(found, suspicions=(*found.suspicions, *unequal, *black_level_off(segment)))


def _diagnosed(model: LineModel) -> Diagnosis:
    inquiry = inquire(model)
    hypothesis = inquiry.best.hypothesis
    rows = tuple(_rows(model, inquiry))
    sentence = sentence_of(inquiry)
    # Levels are not given: under a code that did not make these lines they mean nothing.
    if inquiry.standing is Standing.UNEXPLAINED:
        return Diagnosis(inquiry.standing, sentence, rows)
    if inquiry.standing is Standing.UNCLEAR:
        described = inquiry.described.hypothesis
        return Diagnosis(inquiry.standing, sentence, rows, hypothesis=described, alternative=hypothesis)
    # The search may have ended under the prior of another hypothesis.
    model.fit_prior(hypothesis)
    found = tuple(suspicions(model, hypothesis))
    rival = inquiry.rival if inquiry.standing is Standing.NAMED else None
    alternative = None if rival is None else rival.hypothesis
    return Diagnosis(inquiry.standing, sentence, rows, found, hypothesis=hypothesis, alternative=alternative)


def sentence_of(inquiry: Inquiry) -> str:
    """The verdict in words."""
    if inquiry.standing is Standing.UNEXPLAINED:
        return UNEXPLAINED
    if inquiry.standing is Standing.RIGHT:
        return "the lines confirm their description: the code, its position and the arms' orientation"
    if inquiry.standing is Standing.UNCLEAR and inquiry.best.hypothesis == inquiry.described.hypothesis:
        return "cannot tell: the lines follow a code, but the scene does not show the arms' position"
    words = name_of(inquiry.best.hypothesis)
    if inquiry.standing is Standing.NAMED:
        rival = inquiry.rival
        return words if rival is None else f"{words}; or, equally likely, {name_of(rival.hypothesis)}"
    return f"cannot tell whether the description is right, or {words}"


def name_of(hypothesis: Hypothesis) -> str:
    """A hypothesis in words."""
    parts = []
    if hypothesis.substeps is not None:
        parts.append(f"the lines have {hypothesis.substeps} sub-steps (S)")
    if hypothesis.inverted:
        parts.append("the code is inverted: the light is on where the code is 0")
    a, b = hypothesis.late
    if a == b != 0:
        parts.append(f"the lines are {_late(a)} against the code")
    elif a != b:
        each = [f"arm {arm}'s are {_late(by)}" for arm, by in (("A", a), ("B", b)) if by]
        parts.append(
            f"of the lines, {' and '.join(each)} against the code, or the image is displaced by as many fine "
            "pixels"
        )
    if hypothesis.turn in TURNED:
        parts.append(TURNED[hypothesis.turn])
    return "; ".join(parts) or "as described"


def _late(by: int) -> str:
    return f"{abs(by)} sub-step{'s' if abs(by) > 1 else ''} {'late' if by > 0 else 'early'}"


def _rows(model: LineModel, inquiry: Inquiry) -> list[HypothesisRow]:
    """The table: common mistakes, one at a time, and the candidates that were found, likeliest first."""
    described = inquiry.described
    S, plain = model.substeps, described.hypothesis
    # A mistake is by a sub-step or a whole line, either way.
    tried = [replace(plain, late=(by, by)) for by in (1, -1, S, -S)]
    tried += [replace(plain, turn=turn) for turn in TURNED]
    tried.append(replace(plain, inverted=True))
    found = {candidate.hypothesis: candidate for candidate in inquiry.candidates}
    # This is the prior of the description, with whose likelihood these are compared.
    model.fit_prior(plain)
    for each in tried:
        found.setdefault(each, WeighedHypothesis(each, model.evidence(each)))
    found[plain] = described
    rows = []
    for candidate in found.values():
        likelier, errors = (0.0, 0.0) if candidate is described else advantage(candidate, described)
        rows.append(HypothesisRow(name_of(candidate.hypothesis), likelier, errors, candidate.agreement))
    return sorted(rows, key=lambda row: -row.likelier)


def undo_turn(segment: Segment, turn: Turn) -> Segment:
    """The segment with its arms turned back, so that the forward model applies to it."""
    if turn.rows and turn.pixels:
        return segment.swapped()
    if not (turn.rows or turn.pixels):
        return segment
    return segment.mirrored(0 if turn.rows else 1)
