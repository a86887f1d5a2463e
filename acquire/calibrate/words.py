"""Results of ``acquire calibrate`` in words: values and their uncertainties."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.blur import falling
from acquire.calibrate.apply import CLEAR, belongs_to_flat
from acquire.calibrate.calibration import Measured
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from acquire.calibrate.calibration import AlignmentFound, Calibration, Finding, TileAlignment
    from acquire.calibrate.check import Check

PER_ARM = {
    "balance": ("arm's light relative to the mean", "", 1),
    "dn_per_electron": ("DN per electron", "", 1),
    "read_noise_e": ("read noise", " e", 1),
    "full_well_e": ("full well", " e", 1),
    "light_late_ticks": ("light is late without delays by", " ticks", 1),
    "veil": ("the lens's veil", " %", 100),
    "linearity_error": ("linearity error", " %", 100),
}
"""Quantity → label, unit, and how many of the unit are 1."""
PER_COLUMN = {
    "offset_dn": ("offset", " DN"),
    "noise_dn": ("noise", " DN"),
    "ambient_dn": ("ambient light", " DN"),
}


def found_facts(found: Finding) -> dict[str, Any]:
    """Describe a finding: name → value and uncertainty, in words."""
    facts: dict[str, Any] = {"step": f"{found.step}, {counted(found.facts.get('lines', 0), 'line')}"}
    facts |= _quantities(found.quantities)
    if kept := _full_well_kept(found.facts):
        facts["full well"] = "; ".join(filter(None, (facts.get("full well"), kept)))
    if found.step == "flat":
        facts["arm A's part of the light"] = f"{found.facts['part_a']:.2%}"
        facts["hidden by the optics"] = _columns(found.facts["optics_hide_columns"])
    if found.step == "psf":
        facts["edges"] = ", ".join(f"{arm} {found.facts[arm]['edges']}" for arm in "ab")
    if found.step == "linearity":
        columns = (found.facts[name] for name in ("levels", "reached", "left_over", "powers"))
        rows = list(zip("ab", *columns, strict=True))
        facts["levels"] = "; ".join(
            f"{arm} {count}, up to {part:.0%} of saturation" for arm, count, part, *_ in rows
        )
        facts["left over"] = "; ".join(
            f"{arm} {100 * error:.2g} % with the curve" if powers else f"{arm} is straight: no curve"
            for arm, _, _, error, powers in rows
        )
    if found.step == "delay":
        tick_ns = 1e9 / found.facts["clock_hz"]
        late = found.quantities["light_late_ticks"].value * tick_ns
        facts["that is"] = ", ".join(f"{arm} {each:.0f} ns" for arm, each in zip("ab", late, strict=True))
        facts["in the rig file"] = "; ".join(f"trigger.{k} = {v}" for k, v in found.facts["rig"].items())
    if found.usable is not None and not found.usable.all():
        bad = {arm: np.flatnonzero(~row).tolist() for arm, row in zip("ab", found.usable, strict=True)}
        facts["left out"] = _columns(bad)
    if found.orientation is not None:
        facts["arm B sees the scene with"] = found.orientation
        facts["sure"] = (
            f"correlation {found.facts['correlation']:.2f}, {found.facts['ratio']:.1f} times the next view's"
        )
    if found.alignment is not None:
        facts |= _alignment(found.alignment)
        facts["left over"] = f"{found.facts['misfit']:.1%} of the images' variation"
    return facts | _tiles(found.tiles)


def known_facts(known: Calibration) -> dict[str, Any]:
    """Describe all that a calibration holds, in words."""
    instrument = known.instrument
    facts: dict[str, Any] = {
        "instrument": f"M = {instrument.stages}, S = {instrument.substeps}, {instrument.layout}",
        "cameras": ", ".join(f"{arm} {facts['serial']}" for arm, facts in instrument.cameras.items()),
    }
    facts |= _quantities(known.quantities)
    if known.usable is not None and not known.usable.all():
        facts["left out"] = counted(int((~known.usable).sum()), "column")
    if known.orientation is not None:
        facts["arm B sees the scene with"] = known.orientation
    if known.alignment is not None:
        facts |= _alignment(known.alignment)
    facts |= _tiles(known.tiles)
    if "shading" in known.quantities and not belongs_to_flat(known):
        facts["the lens's light"] = "not used: measured with another flat; repeat acquire calibrate align"
    for name, step in known.steps.items():
        more = [f"full well: {kept}"] if (kept := _full_well_kept(step)) else []
        facts[name] = f"{counted(step.get('lines', 0), 'line')}, {step['made']}" + "".join(
            f"; {text}" for text in (*more, *step.get("warnings", ()))
        )
    return facts


def compared_rows(found: Check) -> list[dict[str, str]]:
    """Return one row for each compared quantity."""
    return [
        {
            "quantity": each.quantity,
            "changed by": f"{each.change:+.4f}",
            "unit": each.unit,
            "sure to": f"{each.sure:.4f}",
            "so": "holds" if each.holds else "changed: measure it again",
        }
        for each in found.compared
    ]


def _full_well_kept(step: Mapping[str, Any]) -> str:
    """Return which full well a repeated transfer has kept; empty if it has measured its own, or none."""
    made = step.get("full_well_made")
    return f"not reached by these lines, so that of {made} is kept" if made else ""


def _quantities(quantities: Any) -> dict[str, str]:
    facts = {}
    for name, (label, unit) in PER_COLUMN.items():
        if name in quantities:
            measured = quantities[name]
            arms = "; ".join(
                f"{arm} {row.mean():.2f}{unit} ({row.min():.2f} to {row.max():.2f})"
                for arm, row in zip("ab", measured.value, strict=True)
            )
            worst = f"{measured.uncertainty.max():.2g}{unit}"
            facts[label] = f"{arms}; uncertain by {worst} in the worst column"
    if "gain" in quantities:
        gain = quantities["gain"]
        spread = " and ".join(f"{row.std():.2%}" for row in gain.value)
        facts["gain"] = (
            f"spread {spread} over the columns of a and b, each uncertain by "
            f"{np.median(gain.uncertainty):.2%}, the worst by {gain.uncertainty.max():.2%}"
        )
    for name, (label, unit, scale) in PER_ARM.items():
        if name in quantities:
            measured = quantities[name]
            facts[label] = _both(Measured(scale * measured.value, scale * measured.uncertainty), unit)
    if "blur_px" in quantities:
        facts["the optics' blur"] = _blur(quantities["blur_px"])
    if "shading" in quantities:
        facts["the lens's light"] = _light(quantities["shading"])
    if "excess_dn" in quantities and quantities["excess_dn"].value.any():
        excess = quantities["excess_dn"]
        worst_at, ends = np.abs(excess.value).argmax(axis=1), excess.value.shape[1] - 1
        facts["off the straight line by"] = "; ".join(
            f"{arm} {row[at]:+.1f} ± {doubt[at]:.2g} DN at {at / ends:.0%} of white"
            for arm, row, doubt, at in zip("ab", excess.value, excess.uncertainty, worst_at, strict=True)
        )
    return facts


def _blur(measured: Measured) -> str:
    """Describe each standard deviation, or its limit if it is not clearly above 0."""
    widths = []
    for arm, row, errors in zip("ab", measured.value, measured.uncertainty, strict=True):
        for axis, value, error in zip(("along", "across"), row, errors, strict=True):
            clear = value > CLEAR * error
            width = (
                f"{value:.2f} ± {error:.2g}"
                if clear
                else f"not clearly above 0 (below {value + 2 * error:.2f})"
            )
            widths.append(f"{arm} {axis} the transfer {width}")
    return "; ".join(widths) + " fine pixels (standard deviation)"


def _light(measured: Measured) -> str:
    """Describe what the darkest corner of each arm's image gets of the light, and its uncertainty."""
    ends = np.array([-1.0, 1.0])
    corners = []
    for arm, (r1, r2, c1, c2, _), errors in zip("ab", measured.value, measured.uncertainty, strict=True):
        rows, columns = falling((r1, r2), ends), falling((c1, c2), ends)
        # the terms of an axis change a corner's light by as much as the other axis lets through
        error = np.hypot(np.hypot(*errors[:2]) * columns.min(), np.hypot(*errors[2:4]) * rows.min())
        corners.append(f"{arm} {rows.min() * columns.min():.1%} ± {error:.1%}")
    return f"{', '.join(corners)} in the darkest corner, relative to the centre"


def _both(measured: Measured, unit: str) -> str:
    return ", ".join(
        f"{arm} {_rounded(value, error):.5g}{unit} ± {error:.2g}"
        for arm, value, error in zip("ab", measured.value, measured.uncertainty, strict=True)
    )


def _rounded(value: float, error: float) -> float:
    """Round a value to the second digit of its uncertainty: the others are chance."""
    return round(value, 1 - math.floor(math.log10(error))) if 0 < error < math.inf else value


def _alignment(found: AlignmentFound) -> dict[str, str]:
    numbers, errors = found.alignment, found.uncertainty
    facts = {
        "arm B lies": f"{numbers.rows:+.3f} ± {errors['rows']:.3f} fine pixels down, "
        f"{numbers.columns:+.3f} ± {errors['columns']:.3f} to the right",
        "turned": f"{numbers.turn_deg:+.4f} ± {errors['turn_deg']:.4f} degrees counter-clockwise",
        "magnified": f"{numbers.magnification:.5f} ± {errors['magnification']:.5f}",
    }
    if numbers.distortion:
        facts["distorted"] = (
            f"{numbers.distortion:+.2%} ± {errors.get('distortion', 0.0):.2%} of half the field outwards, "
            "in the middle of a side"
        )
    return facts


def _tiles(found: Sequence[TileAlignment]) -> dict[str, str]:
    """Describe arm B's alignment in each tile behind a fibre."""
    return {f"in tile {each.tile} arm B lies": _alignment(each.found)["arm B lies"] for each in found}


def _columns(by_arm: dict[str, list[int]]) -> str | None:
    texts = [f"{arm}: columns {', '.join(map(str, columns))}" for arm, columns in by_arm.items() if columns]
    return "; ".join(texts) or None
