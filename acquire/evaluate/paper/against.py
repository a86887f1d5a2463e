"""What is found beside what the paper says: better, equal or worse where it gives a number, and by how much.

Where it says so in words there is only whether they hold; reached is not better.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["better", "equal", "worse", "holds", "does not hold", "no number"]

CAPTURED_R = 0.9
"""Correlation with the truth from which on light that changes counts as captured."""
NEAR = 0.01
"""Relative difference of a frequency that is the same."""


@dataclass(frozen=True, slots=True)
class Row:
    """A line of a figure's table; ``by`` is how much, or what decided it.

    ``no number``: the paper gives none, and no words that could fail.
    """

    what: str
    paper: str
    ours: str
    verdict: Verdict = "no number"
    by: str = ""


def words(what: str, paper: str, ours: str, by: str = "", *, hold: bool) -> Row:
    """A statement of the paper in words, which holds here or does not."""
    return Row(what, paper, ours, "holds" if hold else "does not hold", by)


def same(what: str, paper: str, ours: str, *, equal: bool) -> Row:
    """A size, which is the paper's or is not."""
    return Row(what, paper, ours, "equal" if equal else "worse", "" if equal else "not the paper's size")


def captured(what: str, paper: str, r: float, *, expected: bool = True) -> Row:
    """Light over time, by its correlation with the truth; ``expected`` as the paper has it."""
    sign = "≥" if r >= CAPTURED_R else "<"
    return words(what, paper, f"r = {r:.4f}", f"r {sign} {CAPTURED_R}", hold=(r >= CAPTURED_R) == expected)


def finer(what: str, paper: str, ours: str, elements: int) -> Row:
    """Elements of the USAF target beyond the paper's; six halve the width of a bar."""
    if not elements:
        return Row(what, paper, ours, "equal")
    verdict: Verdict = "better" if elements > 0 else "worse"
    return Row(what, paper, ours, verdict, in_elements(elements))


def in_elements(elements: int) -> str:
    """How much finer or coarser so many elements are."""
    count = abs(elements)
    kind = "finer" if elements >= 0 else "coarser"
    return f"{count} {'element' if count == 1 else 'elements'} {kind}, × {2 ** (count / 6):.2f}"


def frequency(what: str, paper: str, ours: str, found_hz: float, true_hz: float) -> Row:
    """A frequency that the paper finds to be the one that was set."""
    off = found_hz - true_hz
    by = f"{abs(off):.1f} Hz off, {abs(off) / true_hz:.2%}"
    return words(what, paper, ours, by, hold=abs(off) <= NEAR * true_hz)


def sooner(what: str, paper: str, ours: str, seconds: float, paper_s: float, where: str) -> Row:
    """A time against the paper's, measured ``where``: on another machine."""
    ratio = paper_s / seconds
    verdict: Verdict = "better" if ratio > 1 else "worse"
    by = f"× {max(ratio, 1 / ratio):.2g} {'faster' if ratio > 1 else 'slower'}, {where}"
    return Row(what, paper, ours, verdict, by)
