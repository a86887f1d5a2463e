"""Removal of steps from a calibration. Those with whose results others were measured go only with these."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from acquire.calibrate.calibration import FOUND_BY, usable_of
from acquire.calibrate.curve import curve_of
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from acquire.calibrate.calibration import Calibration

NEEDS_DARK = ("ambient", "flat", "transfer", "linearity")
"""Steps that are refused without a dark: that there is one now does not say which one they were made with."""


def without(known: Calibration, steps: Iterable[str], place: str) -> Calibration:
    """Return the calibration without some of its steps: their quantities, facts and warnings.

    Raises UsageError for a step that was not done or that others need, and if none would be left.
    """
    asked = set(steps)
    if absent := sorted(asked - set(known.steps)):
        raise UsageError(f"{place} has no step {absent[0]!r}", possible=", ".join(known.steps) or "none")
    going, why = with_dependents(known, asked)
    if len(going) == len(known.steps):
        text = "; ".join(why) or "a calibration without a step cannot be written"
        raise UsageError(
            f"nothing would be left of {place}: {text}",
            hint=f"measure it again, which replaces it; or rm -r {place}",
        )
    if why:
        names = " ".join(step for step in known.steps if step in going)
        raise UsageError(
            f"{', '.join(sorted(asked))} cannot be forgotten without what depends on it: {'; '.join(why)}",
            possible=f"acquire calibrate forget {names} --out {place}",
            hint="or measure it again: its result then replaces this one",
        )
    left = {name: facts for name, facts in known.steps.items() if name not in going}
    gone = {name for step in going for name in FOUND_BY.get(step, ())}
    if "align" in going:
        # Without a flat, the balance is what `align` has found.
        gone |= {"shading"} if "flat" in left else {"shading", "balance"}
    return replace(
        known,
        quantities={name: each for name, each in known.quantities.items() if name not in gone},
        usable=usable_of(left, known.instrument.columns),
        orientation=None if "orientation" in going else known.orientation,
        alignment=None if "align" in going else known.alignment,
        tiles=() if "align" in going else known.tiles,
        steps=left,
    )


def with_dependents(known: Calibration, asked: Iterable[str]) -> tuple[set[str], list[str]]:
    """Return the steps and all that depend on them, and a reason for each of these."""
    going, reasons = set(asked), list[str]()
    links = _links(known)
    while more := [(step, why) for base, step, why in links if base in going and step not in going]:
        for step, why in dict(more).items():
            going.add(step)
            reasons.append(why)
    return going, reasons


def _links(known: Calibration) -> list[tuple[str, str, str]]:
    """Return which steps cannot stay without which: (the one that goes, the one that cannot stay, why)."""
    steps, found = known.steps, []
    if "dark" in steps:
        needing = [step for step in NEEDS_DARK if step in steps]
        needing += ["veil"] if known.is_after("veil", "dark") else []
        found += [("dark", step, f"{step} was measured with the offsets of dark") for step in needing]
    if curve_of(known) is not None:
        found += [
            ("linearity", step, f"{step} was measured with the curve of linearity")
            for step in ("flat", "transfer", "veil")
            if known.is_after(step, "linearity")
        ]
    if "orientation" in steps and "align" in steps:
        found.append(("orientation", "align", "align was measured in this orientation"))
    corrected = steps.get("align", {}).get("corrected", [])
    if corrected and known.is_after("align", "flat"):
        found.append(
            ("flat", "align", f"align has measured {' and '.join(corrected)} with the gains of flat")
        )
        if own := " and ".join(name for name in corrected if name in FOUND_BY["flat"]):
            found.append(("align", "flat", f"align has replaced {own} of flat by its own"))
    return found
