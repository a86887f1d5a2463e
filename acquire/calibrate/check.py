"""Is a calibration still true? What a new recording says, beside what is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate.apply import check_fits
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.field import mended
from acquire.calibrate.psf import psf
from acquire.calibrate.target import alignment, orientation
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration, Finding
    from acquire.calibrate.exposure import Exposure

SURE = 5.0
"""Standard uncertainties of a difference from which on it is one."""
MATTERS = {
    "offset_dn": 0.5,
    "gain": 0.003,
    "balance": 0.003,
    "pixels": 0.15,
    "turn_deg": 0.1,
    "blur_px": 0.15,
}
"""What a reconstruction notices: smaller changes leave a calibration true, however sure they are."""


@dataclass(frozen=True, slots=True)
class Compared:
    """One quantity, then and now; ``change`` is the largest of its elements, ``sure`` its uncertainty."""

    quantity: str
    unit: str
    change: float
    sure: float
    matters: float

    @property
    def holds(self) -> bool:
        """It did not change, as far as a reconstruction notices."""
        return abs(self.change) <= max(self.matters, SURE * self.sure)


@dataclass(frozen=True, slots=True)
class Check:
    """What a recording says of a calibration.

    ``doubts`` are what may matter beside what was compared; ``same_view``: nothing speaks against the
    orientation.
    """

    compared: tuple[Compared, ...]
    doubts: tuple[str, ...]
    same_view: bool = True

    @property
    def holds(self) -> bool:
        return self.same_view and all(each.holds for each in self.compared)


def check(exposure: Exposure, known: Calibration, *, covered: bool = False) -> Check:
    """Compare what a recording shows with what is known: dark lines, a flat, or a target, by its code.

    Raises UsageError where it is of another instrument, or shows none of these.
    """
    doubts = check_fits(known, exposure.recording)
    if exposure.code_value == 0 or covered:
        found = dark(exposure, covered=covered)
        return Check(tuple(_columns(found, known, "offset_dn", "DN")), doubts)
    if exposure.code_value == 1:
        found = flat(exposure, known)
        seen = found
        if known.alignment is not None:
            corrected = mended(known.with_step(found), known.alignment.alignment)
            seen = replace(found, quantities={**found.quantities, **corrected})
        return Check((*_columns(seen, known, "gain", "1"), *_balance(found, known)), doubts)
    if exposure.recording.fibre is not None:
        raise UsageError(
            f"{exposure.recording} shows a target behind a fibre, which is not compared tile by tile",
            possible="a dark or a flat; or `acquire calibrate align`, which tells where each tile lies now",
        )
    focus, unfocused = _focus(exposure, known)
    doubts += unfocused
    seen = orientation(exposure, known)
    believed = known.orientation or "turn 90"
    if seen.orientation is None or seen.orientation != believed:
        turned = "cannot be told" if seen.orientation is None else f"is {seen.orientation!r}"
        doubt = f"the orientation {turned}; {believed!r} was believed"
        return Check(focus, (*doubts, doubt), same_view=seen.orientation is None)
    return Check((*_alignment(alignment(exposure, known), known), *focus), doubts)


def _focus(exposure: Exposure, known: Calibration) -> tuple[tuple[Compared, ...], tuple[str, ...]]:
    """The optics' blur beside what is known of it, where a target has edges that tell; else why not."""
    if "blur_px" not in known.quantities:
        return (), ()
    try:
        return tuple(_blur(psf(exposure, known), known)), ()
    except UsageError as error:
        return (), (f"the optics' blur was not compared: {error.message}",)


def _columns(found: Finding, known: Calibration, name: str, unit: str) -> Iterator[Compared]:
    if name not in known.quantities:
        return
    before, now = known.quantities[name], found.quantities[name]
    good = np.ones(now.value.shape, np.bool_)
    if known.usable is not None and known.usable.shape == good.shape:
        good &= known.usable
    change: NDArray[np.float64] = np.where(good, now.value - before.value, 0.0)
    sure = np.hypot(now.uncertainty, before.uncertainty)
    at = np.unravel_index((np.abs(change) - SURE * sure).argmax(), change.shape)
    yield Compared(name, unit, float(change[at]), float(sure[at]), MATTERS[name])


def _balance(found: Finding, known: Calibration) -> Iterator[Compared]:
    """Flat beside flat: an alignment may have put the balance right where a flat's light ends."""
    before = known.steps.get("flat", {}).get("part_a")
    if before is not None:
        change, balance = found.facts["part_a"] - before, found.quantities["balance"]
        sure = float(np.hypot(*balance.uncertainty))
        yield Compared("arm A's part of the light", "1", change, sure, MATTERS["balance"])


def _alignment(found: Finding, known: Calibration) -> Iterator[Compared]:
    assert found.alignment is not None  # `alignment` gives one or raises
    before, now = known.alignment, found.alignment
    then = before.alignment.facts() if before else {"magnification": 1.0}
    errors = before.uncertainty if before else {}
    half = known.instrument.stages * known.instrument.substeps / 2
    scales = {"rows": (1.0, "pixels"), "columns": (1.0, "pixels"), "turn_deg": (1.0, "turn_deg")}
    for name, (scale, kind) in (scales | {"magnification": (half, "pixels")}).items():
        change = (now.alignment.facts()[name] - then.get(name, 0.0)) * scale
        sure = float(np.hypot(now.uncertainty[name], errors.get(name, 0.0))) * scale
        unit = "degrees" if kind == "turn_deg" else "fine pixels"
        yield Compared(name, unit, change, sure, MATTERS[kind])


def _blur(found: Finding, known: Calibration) -> Iterator[Compared]:
    before, now = known.quantities["blur_px"], found.quantities["blur_px"]
    for arm, name in enumerate("ab"):
        for axis, along in enumerate(("along", "across")):
            change = float(now.value[arm, axis] - before.value[arm, axis])
            sure = float(np.hypot(now.uncertainty[arm, axis], before.uncertainty[arm, axis]))
            what = f"blur of arm {name} {along} the transfer"
            yield Compared(what, "fine pixels", change, sure, MATTERS["blur_px"])
