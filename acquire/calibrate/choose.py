"""Choice of a recording's calibration: its own copy, another one, or none; and the copy a rig gives it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acquire.calibrate.apply import belongs_to_flat, blur_of, calibration_of, check_fits
from acquire.calibrate.calibration import Calibration, Instrument, differences_between
from acquire.calibrate.curve import curve_of
from acquire.calibrate.file import open_calibration
from acquire.calibrate.orientation import MODEL, view_named
from acquire.errors import AcquireError, ConfigError, PlaceError
from acquire.lines import ARMS
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from acquire.config import RigConfig
    from acquire.store import Recording

NONE = "none"
OWN = "the recording's own"


@dataclass(frozen=True, slots=True)
class Chosen:
    """A calibration, its origin, and doubts about it for the recording, in sentences."""

    calibration: Calibration
    origin: str
    doubts: tuple[str, ...]


def choose(recording: Recording, asked: Path | str | None = None) -> Chosen | None:
    """Return the calibration for a recording: ``asked``, or the copy that it carries; None for ``"none"``.

    Raises UsageError if it does not fit, PlaceError if it is not there, DataError if it is damaged.
    """
    if asked == NONE:
        return None
    known = calibration_of(recording) if asked is None else open_calibration(asked)
    if known is None:
        return None
    return Chosen(known, OWN if asked is None else str(asked), check_fits(known, recording))


def corrected(known: Calibration) -> list[str]:
    """List the corrections of a reconstruction with this calibration, in words that videos store."""
    found = [] if curve_of(known) is None else ["the cameras' curves"]
    for name, words in (
        ("offset_dn", "offsets per column"),
        ("ambient_dn", "ambient light"),
        ("gain", "gains per column"),
        ("balance", "the arms' balance"),
    ):
        if name in known.quantities:
            found.append(words)
    if known.usable is not None and not known.usable.all():
        found.append(f"{counted(int((~known.usable).sum()), 'column')} left out")
    if known.orientation is not None and (view := view_named(known.orientation)) != MODEL:
        shown = " (the video is what camera B sees)" if view.swapped else ""
        found.append(f"the orientation: {view.name}{shown}")
    if known.alignment is not None or known.tiles:
        found.append("arm B laid on arm A")
    if blur_of(known) is not None:
        found.append("the optics' blur")
    if belongs_to_flat(known):
        found.append("the lens's light")
    return found


def provenance(known: Calibration | None) -> dict[str, Any] | None:
    """Return the calibration's share in a result, as JSON."""
    if known is None:
        return None
    steps = {name: step.get("made") for name, step in known.steps.items()}
    return {"corrected": corrected(known), "steps": steps}


@dataclass(frozen=True, slots=True)
class Carried:
    """Attributes of a rig's recordings, and their calibration in words; None if the rig names none."""

    attrs: dict[str, Any]
    place: Path | None = None
    text: str | None = None


def carried_calibration(config: RigConfig, layout: str) -> Carried:
    """Return the attribute ``calibration`` of a rig's recordings.

    If the file does not exist (yet), the attribute is ``calibration_missing``, its path: it is made with this
    rig, and can be added to the recordings afterwards. Raises ConfigError if the calibration is damaged,
    cannot be read, or is of another instrument.
    """
    place = config.calibration
    if place is None:
        return Carried({})
    try:
        known = open_calibration(place)
    except AcquireError as error:
        # a link to nowhere, or something else under this name, is a mistake and not a calibration to come
        if isinstance(error, PlaceError) and not os.path.lexists(place):
            text = f"none: {place} is not there; acquire calibrate all --out {place} makes it"
            return Carried({"calibration_missing": str(place)}, place, text)
        raise ConfigError(
            f"calibration: {error.message}", possible=error.possible, hint=error.hint
        ) from error
    if differences := differences_between(known.instrument, configured(config, layout)):
        raise ConfigError(
            f"calibration: {place} is not one of rig {config.name}: " + "; ".join(differences),
            hint="acquire arm --without-calibration, and acquire calibrate all with another --out",
        )
    text = f"{place}: {', '.join(known.steps)}"
    return Carried({"calibration": known.to_attrs()}, place, text)


def check_rig(
    known: Calibration, place: str, config: RigConfig, reported: Mapping[str, Mapping[str, Any]]
) -> None:
    """Raise UsageError for a calibration of another instrument than a rig's.

    ``reported`` are settings that its cameras have reported, as `exposure.camera_of` returns them: arm →
    settings, and empty before they are armed.
    """
    # A simulated rig with two cameras has the layout of its scene's optics, which its file does not state.
    layout: str = config.cameras.layout
    if layout == "dual" and known.instrument.layout not in ("compact", "fibre"):
        layout = known.instrument.layout
    rig = configured(config, layout)
    cameras = {arm: {**rig.cameras[arm], **reported.get(arm, {})} for arm in ARMS}
    known.check_same(rig.model_copy(update={"cameras": cameras}), f"rig {config.name}", place)


def configured(config: RigConfig, layout: str) -> Instrument:
    """Return the instrument that a rig file describes."""
    cameras = {arm: config.cameras.arm(arm) for arm in ARMS}
    return Instrument(
        stages=config.geometry.stages,
        substeps=config.geometry.substeps,
        substep_s=config.trigger.substep_ticks / config.trigger.clock_hz,
        layout=layout,
        cameras={
            arm: {
                # what a recording states, too (`instrument_of`): only what both state is compared
                "serial": camera.serial,
                "PixelFormat": camera.pixel_format,
                "white_dn": camera.white_dn,
                "black_level_dn": camera.black_level_dn,
                "responsivity_dn": camera.responsivity_dn,
            }
            for arm, camera in cameras.items()
        },
        pixels=None if config.fibre is None else config.pixels,
    )
