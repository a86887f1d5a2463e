"""Which calibration a recording is read with: its own copy, another one, or none; and what a rig hands on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acquire.calibrate.apply import calibration_of, check_fits
from acquire.calibrate.calibration import Calibration, Instrument, differing
from acquire.calibrate.file import open_calibration
from acquire.calibrate.orientation import MODEL, view_named
from acquire.errors import AcquireError, ConfigError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.config import RigConfig
    from acquire.store import Recording

NONE = "none"
OWN = "the recording's own"


@dataclass(frozen=True, slots=True)
class Chosen:
    """A calibration, where it is from, and what is doubtful about it for the recording, in sentences."""

    calibration: Calibration
    origin: str
    doubts: tuple[str, ...]


def choose(recording: Recording, asked: Path | str | None = None) -> Chosen | None:
    """The calibration for a recording: ``asked``, or the copy that it carries; None for ``"none"``.

    Raises UsageError for one that does not fit, PlaceError where there is none, DataError for a damaged one.
    """
    if asked == NONE:
        return None
    known = calibration_of(recording) if asked is None else open_calibration(asked)
    if known is None:
        return None
    return Chosen(known, OWN if asked is None else str(asked), check_fits(known, recording))


def corrected(known: Calibration) -> list[str]:
    """What a reconstruction corrects with a calibration, in words."""
    found = []
    for name, words in (
        ("offset_dn", "offsets per column"),
        ("ambient_dn", "ambient light"),
        ("gain", "gains per column"),
        ("balance", "the arms' balance"),
    ):
        if name in known.quantities:
            found.append(words)
    if known.usable is not None and not known.usable.all():
        found.append(f"{int((~known.usable).sum())} columns left out")
    if known.orientation is not None and (view := view_named(known.orientation)) != MODEL:
        seen = " (the video is what camera B sees)" if view.swapped else ""
        found.append(f"the orientation: {view.name}{seen}")
    if known.alignment is not None:
        found.append("arm B laid on arm A")
    return found


def provenance(known: Calibration | None) -> dict[str, Any] | None:
    """What of a calibration went into a result, as JSON."""
    if known is None:
        return None
    steps = {name: step.get("made") for name, step in known.steps.items()}
    return {"corrected": corrected(known), "steps": steps}


def handed_on(config: RigConfig, layout: str) -> dict[str, Any]:
    """The attribute ``calibration`` that a rig's recordings get; nothing where the rig names none.

    Raises ConfigError where the calibration is not there, damaged, or of another instrument.
    """
    if config.calibration is None:
        return {}
    try:
        known = open_calibration(config.calibration)
    except AcquireError as error:
        raise ConfigError(
            f"calibration: {error.message}", possible=error.possible, hint=error.hint
        ) from error
    if differences := differing(known.instrument, configured(config, layout)):
        raise ConfigError(
            f"calibration: {config.calibration} is not of rig {config.name}: " + "; ".join(differences),
            hint="acquire calibrate, to make one of it",
        )
    return {"calibration": known.to_attrs()}


def configured(config: RigConfig, layout: str) -> Instrument:
    """The instrument that a rig file describes."""
    cameras = {arm: config.cameras.arm(arm) for arm in ARMS}
    return Instrument(
        stages=config.geometry.stages,
        substeps=config.geometry.substeps,
        substep_s=config.trigger.substep_ticks / config.trigger.clock_hz,
        layout=layout,
        cameras={
            arm: {
                "serial": camera.serial,
                "PixelFormat": camera.pixel_format,
                "white_dn": camera.white_dn,
                "black_level_dn": camera.black_level_dn,
                "responsivity_dn": camera.responsivity_dn,
            }
            for arm, camera in cameras.items()
        },
    )
