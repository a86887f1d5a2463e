"""Steps with a target at rest under a pseudo-random code: orientation and alignment of the arms."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.blur import falling
from acquire.calibrate.align import Match, align
from acquire.calibrate.apply import calibrated
from acquire.calibrate.calibration import TERMS, Finding, Measured, TileAlignment
from acquire.calibrate.checks import refuse_constant
from acquire.calibrate.field import field_edge
from acquire.calibrate.orientation import (
    CLEAR,
    LEAST_CORRELATION,
    MODEL,
    View,
    correlations,
    view_named,
)
from acquire.calibrate.still import stills
from acquire.errors import UsageError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure
    from acquire.calibrate.still import Still
    from acquire.lines import Segment

MOST_LINES = 4096
"""Upper limit on the lines used; more do not make an alignment better than its model."""
UNLIKE = 0.5
"""Misfit of the arms' images, relative to their variation, beyond which they do not show the same."""
UNEXPLAINED = 0.5
"""Part of an arm's lines that no scene at rest under the code explains, beyond which they do not follow it:
noise alone has 0.9, a target 0.01."""
PLAIN = 0.1
"""Variation of an image relative to its mean up to which it shows no target: columns differ by 1 to 3 %."""
UNREST = 0.3
"""Correlation of the residuals of successive lines from which the target moved. One that moves by 0.3 fine
pixels while 1024 lines are recorded has 0.4, by one 0.8; the shift is then wrong by 0.01 and by 0.05."""
COARSE = 8
"""Width of the target's detail, in fine pixels, from which an alignment is less certain than it says."""
ENOUGH_FINE = 0.08
"""Share of fine detail with which it is certain all the same. The sheet has large squares among its dots, and
a share of 0.08 to 0.14, with a blur of up to 1.3 fine pixels; dots that a blur of 4 leaves coarse have 0.04
to 0.07."""
LESS_CERTAIN = "the alignment is less certain than it says"
"""What warnings of an unfit target say."""
SAME_BALANCE = 0.002
"""Difference of the arms' light up to which the flat's balance is kept."""
BALANCE_ERROR = 0.001
"""Uncertainty of the ratio of the arms' light over the field that both see."""


def orientation(exposure: Exposure, known: Calibration) -> Finding:
    """Find which of eight views of the scene arm B has; None in the finding if it is not clear.

    Raises UsageError for too few lines, and for a code that does not determine an image.
    """
    still_a, still_b = stills(_segment(exposure, replace(known, orientation=None, alignment=None)))
    view, facts = clearest_view(still_a, still_b, exposure.instrument.substeps)
    warnings: tuple[str, ...] = ()
    if view is None:
        why = _why_unclear((still_a, still_b), facts, exposure.instrument.substeps)
        warnings = (f"the orientation is not clear: {why}",)
    elif not view.crosses:
        warnings = (
            f"arm B sees the scene with {view.name}: both cameras transfer along the same axis; turn one of "
            "them by 90 degrees",
        )
    return Finding(
        "orientation",
        exposure.instrument,
        orientation=None if view is None else view.name,
        facts={**exposure.facts(), **facts},
        warnings=warnings,
    )


def _why_unclear(pair: tuple[Still, Still], facts: dict[str, Any], substeps: int) -> str:
    """Return what is wrong with the light or the scene, if the images show it, and what would help."""
    unlit = [arm for arm, each in zip(ARMS, pair, strict=True) if each.misfit > UNEXPLAINED]
    if unlit:
        return (
            f"the lines of arm {' and '.join(unlit)} do not follow the light's code; switch the light on, "
            "open the lens, and keep the scene at rest"
        )
    contrasts = {arm: each.contrast(substeps) for arm, each in zip(ARMS, pair, strict=True)}
    if plain := {arm: contrast for arm, contrast in contrasts.items() if contrast < PLAIN}:
        found = " and ".join(f"{contrast:.1%} in arm {arm}" for arm, contrast in plain.items())
        return f"the scene is nearly uniform, its brightness varies by {found}; put the target in, and focus"
    return (
        f"the best view correlates with {facts['correlation']:.2f}, {facts['next']['view']} with "
        f"{facts['next']['correlation']:.2f}; a target with sharp, irregular texture would show it"
    )


def clearest_view(a: Still, b: Still, substeps: int) -> tuple[View | None, dict[str, Any]]:
    """Return the view that fits the arms' images, or None if it is not clear, and the correlations."""
    found = correlations(a.blocks(substeps), b.blocks(substeps))
    ranked = sorted(found, key=lambda view: -found[view][0])
    best, following = found[ranked[0]][0], max(found[ranked[1]][0], 1e-3)
    clear = best >= LEAST_CORRELATION and best >= CLEAR * following
    facts = {
        "correlation": round(best, 4),
        "next": {"view": ranked[1].name, "correlation": round(following, 4)},
        "ratio": round(best / following, 3),
    }
    return (ranked[0] if clear else None), facts


def alignment(exposure: Exposure, known: Calibration) -> Finding:
    """Measure arm B's alignment with arm A, and the arms' balance over the field that both see.

    Raises UsageError for a target that does not determine it, or that shows another orientation than known.
    """
    segment = _segment(exposure, replace(known, alignment=None))
    geometry, S = segment.geometry, segment.geometry.substeps
    still_a, still_b = stills(segment)
    view, facts = clearest_view(still_a, still_b, S)
    # `_segment` has corrected the known orientation, which leaves the model's
    if view is not None and view != MODEL:
        expected = MODEL.name if known.orientation is None else known.orientation
        raise UsageError(
            f"{exposure.recording}: arm B does not see the scene with {expected}, the known orientation",
            hint="run acquire calibrate orientation with the same recording",
        )
    shift = correlations(still_a.blocks(S), still_b.blocks(S))[MODEL][1]
    # the shift is in blocks of S fine pixels
    match = align(still_a, still_b, geometry, (S * shift[0], S * shift[1]))
    _refuse_unlike(exposure, match)
    # now that the alignment shows which columns of arm B look beyond the field
    edge = field_edge(known, match.found.alignment, dimmed=match.fall_off.in_b)
    quantities = dict(edge.quantities)
    shading: dict[str, Measured] = {}
    if "gain" in known.quantities and not known.steps.get("flat", {}).get("smooth", True):
        corrected = replace(known, quantities={**known.quantities, **quantities})
        if edge.ends:
            # with the gains as they are now
            segment = _segment(exposure, replace(corrected, alignment=None))
            match = align(*stills(segment), geometry, (S * shift[0], S * shift[1]))
        shading = _shading(corrected, exposure, match)
    if shading:
        match = replace(match, brightness=match.fall_off.brightness)
        quantities = {**quantities, **shading, **_balance(corrected, match)}
    elif not edge.ends:
        quantities |= _balance(known, match)
    facts = {
        **exposure.facts(),
        "lines": len(segment.time_ns),
        **facts,
        "misfit": round(match.misfit, 4),
        "lines_misfit": [round(still_a.misfit, 5), round(still_b.misfit, 5)],
        "brightness": round(match.brightness, 5),
        "shading_of_flat": known.steps["flat"].get("made") if shading else None,
        "dimmed": match.fall_off.in_b,
        "fall_off": match.fall_off.facts(),
        "corrected": _corrected(known, quantities),
    }
    warnings = _unfit(known, still_a, still_b)
    if edge.ends:
        warnings.append(
            "the flat's light ends at the field's edge, and arm B sees beyond it: gain and balance are "
            "corrected, but a larger white scene is better"
        )
    elif "balance" in quantities and not shading:
        more = f"{abs(match.brightness - 1):.1%} {'brighter' if match.brightness > 1 else 'darker'}"
        than = "in the flat" if "flat" in known.steps else "arm A"
        warnings.append(
            f"over the field that both arms see, arm B is {more} than {than}: the balance is corrected"
        )
    if shading:
        x = np.linspace(-1, 1, 65)
        terms = shading["shading"].value[:, :4].reshape(-1, 2)
        least = min(float(falling((first, second), x).min()) for first, second in terms)
        warnings.append(
            f"the light falls to {least:.0%} towards a side, by lens or lamp: the model includes it"
        )
    elif match.fall_off.clear:
        why = "a flat with --smooth has" if "flat" in known.steps else "without a flat there is"
        warnings.append(
            f"{match.fall_off.words}: {why} no profile of the lens, and the model does not include it; a "
            "flat of a uniform scene without --smooth, and align after it, would"
        )
    return Finding(
        "align",
        exposure.instrument,
        quantities,
        alignment=match.found,
        facts=facts,
        warnings=tuple(warnings),
    )


def _refuse_unlike(exposure: Exposure, match: Match) -> None:
    """Raise UsageError for images that do not show the same."""
    if match.misfit > UNLIKE:
        raise UsageError(
            f"{exposure.recording}: the arms' images differ by {match.misfit:.0%} of their variation, and do "
            "not show the same",
            possible="a target at rest, in focus in both cameras, under the recording's own code",
            hint="acquire diagnose checks the code; acquire camera live shows the focus",
        )


def _unfit(known: Calibration, *stills: Still) -> list[str]:
    """Warn of a target that moved, and of one without fine detail."""
    warnings = []
    unrest, detail = max(each.unrest for each in stills), max(each.detail for each in stills)
    # an unknown offset is in all lines alike, too
    if "offset_dn" in known.quantities and unrest > UNREST:
        warnings.append(
            f"the target moved while it was recorded, or its light flickered (successive lines are alike to "
            f"{unrest:.0%} in what a scene at rest does not explain): {LESS_CERTAIN}; repeat it with the "
            "target at rest"
        )
    if detail >= COARSE and min(each.fine for each in stills) < ENOUGH_FINE:
        warnings.append(
            f"the target's detail is about {detail} fine pixels wide: coarse, or out of focus; "
            f"{LESS_CERTAIN}; focus both cameras, or use a target with detail of 2 to 6"
        )
    return warnings


def tile_alignments(exposure: Exposure, known: Calibration) -> Finding:
    """Measure arm B's alignment with arm A in each tile behind a fibre, whose bands are slightly displaced.

    A tile in which the target does not determine it is left out and named in a warning. Raises UsageError if
    no tile remains.
    """
    # no orientation: in a mirrored arm other columns would see the tile
    recording, bare = exposure.recording, replace(known, orientation=None, alignment=None, tiles=())
    assert recording.fibre is not None
    lines, found, warnings = min(exposure.lines, MOST_LINES), [], []
    for tile in recording.fibre.tiles:
        segment = calibrated(recording.cut(exposure.first_line, lines, tile), bare)
        S = segment.geometry.substeps
        try:
            still_a, still_b = stills(segment)
            shift = correlations(still_a.blocks(S), still_b.blocks(S))[MODEL][1]
            match = align(still_a, still_b, segment.geometry, (S * shift[0], S * shift[1]))
        except UsageError as error:
            warnings.append(f"tile {tile}: {error.message}")
            continue
        if match.misfit > UNLIKE:
            warnings.append(f"tile {tile}: the arms' images differ by {match.misfit:.0%} of their variation")
            continue
        if match.fall_off.clear:
            warnings.append(f"tile {tile}: {match.fall_off.words}; behind a fibre this is not corrected")
        found.append(TileAlignment(str(tile), segment.first_column, match.found))
    if not found:
        raise UsageError(
            f"{recording}: the target does not determine the alignment of the arms in any tile",
            possible="sharp dots or a binary pattern of 2 to 6 fine pixels all over",
        )
    facts = {**exposure.facts(), "lines": lines, "tiles": len(found)}
    return Finding("align", exposure.instrument, facts=facts, warnings=tuple(warnings), tiles=tuple(found))


def _shading(known: Calibration, exposure: Exposure, match: Match) -> dict[str, Measured]:
    """Return what each lens takes of the light; nothing if the arms' images do not show it.

    A flat gives the profile of arm A's columns and of arm B's, which are the scene's rows: it is in their
    gains. With gains that contain it, arm A's image still has the profile of its rows and arm B's that of the
    scene's columns, which their ratio shows. Columns whose gain `flat` has set to 1, since they are dark, get
    the profile instead.
    """
    if not match.fall_off.clear:
        return {}
    r1, r2, c1, c2 = match.fall_off.terms
    rows, columns = match.fall_off.errors[:2], match.fall_off.errors[2:]
    # A few lines, since of them only the order of arms and columns is needed.
    bare, measured = replace(exposure, lines=2).whole(), known.quantities["gain"]
    places = np.arange(measured.value.size, dtype=np.float64).reshape(measured.value.shape)
    # from 1, since a responsivity is above 0
    numbered = replace(bare, responsivity_dn=places + 1)
    # the places of the model's arms and columns among the cameras'
    at = np.asarray(calibrated(numbered, replace(known, quantities={}, alignment=None)).responsivity_dn)
    at = at.astype(np.int64) - 1
    gains, filled = measured.value.ravel()[at], measured.value.ravel().copy()
    seen = calibrated(bare, replace(known, alignment=None)).mask.any(axis=1)
    x = (np.arange(gains.shape[1]) + 0.5) * 2 / gains.shape[1] - 1
    values, errors = np.zeros((2, TERMS)), np.zeros((2, TERMS))
    for arm, (gain, good) in enumerate(zip(gains, seen & (gains != 1.0), strict=True)):
        design = np.stack([np.ones_like(x), x, x**2], axis=1)[good]
        fitted, residual, *_ = np.linalg.lstsq(design, gain[good], rcond=None)
        spread = float(residual.sum()) / max(1, good.sum() - 3)
        doubt = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * spread)
        own, sure = fitted[1:] / fitted[0], doubt[1:] / fitted[0]
        assumed = gain == 1.0
        filled[at[arm, assumed]] = falling(tuple(own), x[assumed]) * fitted[0]
        values[arm] = [*own, c1, c2, fitted[0]] if arm else [r1, r2, *own, fitted[0]]
        errors[arm] = [*sure, *columns, doubt[0]] if arm else [*rows, *sure, doubt[0]]
    gains_filled = Measured(filled.reshape(measured.value.shape), measured.uncertainty)
    return {"shading": Measured(values, errors), "gain": gains_filled}


def _corrected(known: Calibration, quantities: Mapping[str, Measured]) -> list[str]:
    """Return, in words, what differs from the values of the flat, not only in its uncertainty."""
    changed = {
        name
        for name, each in quantities.items()
        if name not in known.quantities or not np.array_equal(each.value, known.quantities[name].value)
    }
    if known.is_after("align", "flat"):
        # An earlier target has corrected the same flat, and this one only the rest.
        changed |= {"gain", "balance"}.intersection(known.steps["align"].get("corrected", ()))
    return ["the lens's light" if name == "shading" else name for name in sorted(changed)]


def _balance(known: Calibration, match: Match) -> dict[str, Measured]:
    """Return the corrected balance if the common field is brighter in one arm; else nothing."""
    if abs(match.brightness - 1) <= SAME_BALANCE:
        return {}
    before = known.value("balance")
    # flats compare the light of the arms' whole fields, targets that of what both see
    before = np.ones(2) if before is None else before
    swapped = known.orientation is not None and view_named(known.orientation).swapped
    # if the arms are swapped, the model's arm B is camera A
    ratio = before[1] / before[0] * (1 / match.brightness if swapped else match.brightness)
    balance = np.array([2 / (1 + ratio), 2 * ratio / (1 + ratio)])
    return {"balance": Measured(balance, BALANCE_ERROR * balance)}


def _segment(exposure: Exposure, known: Calibration) -> Segment:
    refuse_constant(exposure)
    lines = min(exposure.lines, MOST_LINES)
    return calibrated(replace(exposure, lines=lines).whole(), known)
