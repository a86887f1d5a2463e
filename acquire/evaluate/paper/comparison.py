"""Comparison of our results with the paper: better, equal or worse than its numbers, and by how much.

For a statement in words the verdict is only whether it holds; reaching it does not count as better.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["better", "equal", "worse", "holds", "does not hold", "no number"]

CAPTURED_R = 0.9
"""Least correlation with the truth for changing light to count as captured."""
NEAR = 0.01
"""Largest relative difference of frequencies that count as the same."""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a figure's table; ``by`` is the difference, or the criterion of the verdict.

    The verdict is ``no number`` if the paper gives neither a number nor a statement that could fail.
    """

    what: str
    paper: str
    ours: str
    verdict: Verdict = "no number"
    by: str = ""


def statement(what: str, paper: str, ours: str, by: str = "", *, hold: bool) -> Row:
    """Return the row of a statement in words, which holds here or does not."""
    return Row(what, paper, ours, "holds" if hold else "does not hold", by)


def same(what: str, paper: str, ours: str, *, equal: bool) -> Row:
    """Return the row of a size, which equals the paper's or does not."""
    return Row(what, paper, ours, "equal" if equal else "worse", "" if equal else "not the paper's size")


def captured(what: str, paper: str, r: float, *, expected: bool = True) -> Row:
    """Return the row of light over time, judged by its correlation with the truth.

    ``expected`` is whether the paper captures it.
    """
    sign = "≥" if r >= CAPTURED_R else "<"
    hold = (r >= CAPTURED_R) == expected
    return statement(what, paper, f"r = {r:.4f}", f"r {sign} {CAPTURED_R}", hold=hold)


def finer(what: str, paper: str, ours: str, elements: int) -> Row:
    """Return the row of a resolution, in elements of the USAF target beyond the paper's.

    Six elements halve the width of a bar.
    """
    if not elements:
        return Row(what, paper, ours, "equal")
    verdict: Verdict = "better" if elements > 0 else "worse"
    return Row(what, paper, ours, verdict, in_elements(elements))


def in_elements(elements: int) -> str:
    """Describe how much finer or coarser a number of elements is."""
    # Six elements double the line pairs per mm: these are 2^(group + (element − 1)/6).
    count = abs(elements)
    kind = "finer" if elements >= 0 else "coarser"
    return f"{count} {'element' if count == 1 else 'elements'} {kind}, × {2 ** (count / 6):.2f}"


def frequency(what: str, paper: str, ours: str, found_hz: float, true_hz: float) -> Row:
    """Return the row of a frequency, which the paper states to be the one that was set."""
    error_hz = abs(found_hz - true_hz)
    by = f"error {error_hz:.1f} Hz, {error_hz / true_hz:.2%}"
    return statement(what, paper, ours, by, hold=error_hz <= NEAR * true_hz)


def faster(what: str, paper: str, ours: str, *, seconds: float, paper_s: float, where: str) -> Row:
    """Return the row of a time; ``where`` names the machine on which the paper measured its own."""
    ratio = paper_s / seconds
    verdict: Verdict = "better" if ratio > 1 else "worse"
    by = f"× {max(ratio, 1 / ratio):.2g} {'faster' if ratio > 1 else 'slower'}, {where}"
    return Row(what, paper, ours, verdict, by)
