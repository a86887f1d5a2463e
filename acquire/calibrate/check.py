"""Check of a calibration against a new recording: is it still valid?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate.apply import check_fits
from acquire.calibrate.calibration import Finding, Measured
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.field import field_edge
from acquire.calibrate.psf import psf
from acquire.calibrate.target import LESS_CERTAIN, alignment, orientation
from acquire.errors import UsageError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure

QUARTIC, FEWEST_COLUMNS = 5, 12
"""Terms of the fall of the light over an arm's columns, and how many of these determine it."""
SURE = 5.0
"""Standard uncertainties from which a difference is significant."""
MATTERS = {
    "offset_dn": 0.5,
    "gain": 0.003,
    "balance": 0.003,
    "pixels": 0.15,
    "turn_deg": 0.1,
    "blur_px": 0.15,
    "light": 0.01,
}
"""Changes that a reconstruction notices; smaller ones leave a calibration true, however certain they are."""


@dataclass(frozen=True, slots=True)
class Compared:
    """Change of one quantity: ``change`` is the largest of its elements, ``sure`` its uncertainty."""

    quantity: str
    unit: str
    change: float
    sure: float
    matters: float

    @property
    def holds(self) -> bool:
        """Whether the change is too small for a reconstruction to notice, or not significant."""
        return abs(self.change) <= max(self.matters, SURE * self.sure)


@dataclass(frozen=True, slots=True)
class Check:
    """Result of comparing a recording with a calibration.

    ``doubts`` are further concerns, apart from the compared quantities. ``same_view`` is whether nothing
    contradicts the orientation.
    """

    compared: tuple[Compared, ...]
    doubts: tuple[str, ...]
    same_view: bool = True

    @property
    def holds(self) -> bool:
        return self.same_view and all(each.holds for each in self.compared)


def check(exposure: Exposure, known: Calibration, *, covered: bool = False) -> Check:
    """Compare a recording of dark lines, a flat or a target, depending on its code, with a calibration.

    Raises UsageError if it is of another instrument, or shows none of these.
    """
    doubts = check_fits(known, exposure.recording)
    if exposure.code_value == 0 or covered:
        found = dark(exposure, covered=covered)
        return Check(tuple(_columns(found, known, "offset_dn", "DN")), doubts)
    if exposure.code_value == 1:
        found = flat(exposure, known)
        corrected = found
        if known.alignment is not None:
            # as `align` corrected the calibration's own flat
            # calibrations from before it was noted have a fall of the light if there was one
            dimmed = bool(known.steps.get("align", {}).get("dimmed", "shading" in known.quantities))
            edge = field_edge(known.with_step(found), known.alignment.alignment, dimmed=dimmed)
            corrected = replace(found, quantities={**found.quantities, **edge.quantities})
        light, corrected = _light_of_flat(corrected, known)
        compared = [*_columns(corrected, known, "gain", "1"), *light]
        # The flats themselves, since an alignment may have corrected the balance of the calibration.
        before = known.steps.get("flat", {}).get("part_a")
        if before is not None:
            change, balance = found.facts["part_a"] - before, found.quantities["balance"]
            sure = float(np.hypot(*balance.uncertainty))
            compared.append(Compared("arm A's part of the light", "1", change, sure, MATTERS["balance"]))
        return Check(tuple(compared), doubts)
    if exposure.recording.fibre is not None:
        raise UsageError(
            f"{exposure.recording} shows a target behind a fibre, which is not compared tile by tile",
            possible="a dark or a flat; or `acquire calibrate align`, which measures each tile's alignment",
        )
    blur: tuple[Compared, ...] = ()
    if "blur_px" in known.quantities:
        try:
            blur = tuple(_blur(psf(exposure, known), known))
        except UsageError as error:  # many targets have no edges that show the blur
            doubts += (f"the optics' blur was not compared: {error.message}",)
    found = orientation(exposure, known)
    expected = known.orientation or "turn 90"  # `MODEL`, if none was measured
    if found.orientation is None or found.orientation != expected:
        result = "is not clear" if found.orientation is None else f"is {found.orientation!r}"
        doubt = f"the orientation {result}; the calibration has {expected!r}"
        return Check(blur, (*doubts, doubt), same_view=found.orientation is None)
    aligned = alignment(exposure, known)
    # Of such a target, what seems to have changed need not have.
    doubts += tuple(each for each in aligned.warnings if LESS_CERTAIN in each)
    return Check((*_alignment(aligned, known), *_light_of_target(aligned, known), *blur), doubts)


def _columns(found: Finding, known: Calibration, name: str, unit: str) -> Iterator[Compared]:
    if name not in known.quantities:
        return
    before, now = known.quantities[name], found.quantities[name]
    good = np.ones(now.value.shape, np.bool_)
    if known.usable is not None and known.usable.shape == good.shape:
        good &= known.usable
    change: NDArray[np.float64] = np.where(good, now.value - before.value, 0.0)
    sure = np.hypot(now.uncertainty, before.uncertainty)
    # the change that exceeds its own limit (`Compared.holds`) by most; it need not be the largest, and a
    # small one beyond doubt must not hide it
    limit = np.maximum(MATTERS[name], SURE * sure)
    at = np.unravel_index((np.abs(change) - limit).argmax(), change.shape)
    yield Compared(name, unit, float(change[at]), float(sure[at]), MATTERS[name])


def _light_of_flat(found: Finding, known: Calibration) -> tuple[list[Compared], Finding]:
    """Compare the fall of the light over the columns; return the flat without a change of it that counts.

    A lens, or a lamp, changes the gains smoothly, and is not a change of the columns.
    """
    if "gain" not in known.quantities:
        return [], found
    before, now = known.quantities["gain"], found.quantities["gain"]
    x, rest = np.linspace(-1, 1, before.value.shape[1]), now.value.copy()
    changes = []
    for arm, name in enumerate(ARMS):
        # a gain of 1 is assumed where the optics hide the column
        good = (before.value[arm] != 1.0) & (now.value[arm] != 1.0)
        good &= np.isin(np.arange(len(x)), _hidden(known, name) + _hidden(found, name), invert=True)
        good &= True if known.usable is None else known.usable[arm]
        if good.sum() <= FEWEST_COLUMNS:
            return [], found
        # the quotient of two parabolas, which is not one itself
        design = np.vander(x, QUARTIC, increasing=True)
        ratio = now.value[arm, good] / before.value[arm, good]
        terms = np.linalg.lstsq(design[good], ratio, rcond=None)[0]
        profile = design @ terms
        spread = float(np.square(ratio - profile[good]).sum()) / (good.sum() - QUARTIC)
        errors = np.sqrt(np.diag(design @ np.linalg.inv(design[good].T @ design[good]) @ design.T) * spread)
        ends = profile[[0, -1]] / profile[len(x) // 2] - 1
        worst = int(np.abs(ends).argmax())
        changes.append((float(ends[worst]), float(errors[[0, -1]][worst])))
        rest[arm] /= np.where(good, profile, 1.0)
    change, sure = max(changes, key=lambda each: abs(each[0]))
    light = Compared("light towards a side, in the flat", "1", change, sure, MATTERS["light"])
    if light.holds:
        return [light], found
    quantities = {**found.quantities, "gain": Measured(rest, now.uncertainty)}
    return [light], replace(found, quantities=quantities)


def _light_of_target(found: Finding, known: Calibration) -> Iterator[Compared]:
    """Compare what the arms' images of a target show of the fall of the light: the differences of both.

    Lenses, or lamps, that change alike in both arms are seen in a flat only.
    """
    before, now = known.steps.get("align", {}).get("fall_off"), found.facts["fall_off"]
    if before is None or "gain" not in known.quantities:
        return
    change, doubt = (
        np.subtract(now["terms"], before["terms"]),
        np.hypot(now["uncertainty"], before["uncertainty"]),
    )
    # of A's rows, then of B's columns, at either side: t₂ ± t₁
    sides = [
        (change[i + 1] + sign * change[i], np.hypot(*doubt[i : i + 2])) for i in (0, 2) for sign in (-1, 1)
    ]
    largest, sure = max(sides, key=lambda each: abs(each[0]))
    yield Compared(
        "light towards a side, arm against arm", "1", float(largest), float(sure), MATTERS["light"]
    )


def _hidden(measured: Finding | Calibration, arm: str) -> list[int]:
    """Return the columns of an arm whose gain the optics hid in the flat."""
    facts = measured.facts if isinstance(measured, Finding) else measured.steps.get("flat", {})
    return list(facts.get("optics_hide_columns", {}).get(arm, []))


def _alignment(found: Finding, known: Calibration) -> Iterator[Compared]:
    assert found.alignment is not None  # `alignment` returns one or raises
    before, now = known.alignment, found.alignment
    # without an alignment, a reconstruction takes the arms to coincide
    then = before.alignment.facts() if before else {"magnification": 1.0}
    errors = before.uncertainty if before else {}
    # magnification and distortion are compared by what they displace at the field's edge
    half = known.instrument.stages * known.instrument.substeps / 2
    scales = {"rows": (1.0, "pixels"), "columns": (1.0, "pixels"), "turn_deg": (1.0, "turn_deg")}
    for name, (scale, kind) in (
        scales | dict.fromkeys(("magnification", "distortion"), (half, "pixels"))
    ).items():
        change = (now.alignment.facts()[name] - then.get(name, 0.0)) * scale
        # a distortion that is 0 has no uncertainty
        sure = float(np.hypot(now.uncertainty.get(name, 0.0), errors.get(name, 0.0))) * scale
        unit = "degrees" if kind == "turn_deg" else "fine pixels"
        yield Compared(name, unit, change, sure, MATTERS[kind])


def _blur(found: Finding, known: Calibration) -> Iterator[Compared]:
    before, now = known.quantities["blur_px"], found.quantities["blur_px"]
    for arm, name in enumerate("ab"):
        for axis, along in enumerate(("along", "across")):
            change = float(now.value[arm, axis] - before.value[arm, axis])
            sure = float(np.hypot(now.uncertainty[arm, axis], before.uncertainty[arm, axis]))
            quantity = f"blur of arm {name} {along} the transfer"
            yield Compared(quantity, "fine pixels", change, sure, MATTERS["blur_px"])
