"""Calibration of an instrument: from recordings of known light to the corrections of a reconstruction.

::

    recordings ──▶ exposure ──▶ dark, flat, transfer, orientation, align, psf, veil ──▶ Finding
                                                                                         │
    recording's copy ◀── Calibration ◀── file (Zarr group) ◀── with_step ◀───────────────┘
                             │
                             └──▶ apply: a segment's offsets, responsivities, mask, alignment, optics

    steps       columns (dark, ambient, flat), linearity and curve, delay and delay_sweep,
                target (orientation, align) with field, psf, veil; still: a target's image from one arm;
                sheet: a drawing that serves for all four
    around them checks (does the recording suit?), guide (what to put in front of the lens), words
    afterwards  choose (which calibration), check (is it still valid?), forget (a step again)

A calibration holds measurements and nothing else, and a property that was not measured is not corrected.
Lines on disk are never altered.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.lazy import lazily

if TYPE_CHECKING:
    from acquire.calibrate.apply import calibrated, calibration_of
    from acquire.calibrate.calibration import AlignmentFound, Calibration, Finding, Instrument, Measured
    from acquire.calibrate.file import open_calibration, save_calibration

__all__ = [
    "AlignmentFound",
    "Calibration",
    "Finding",
    "Instrument",
    "Measured",
    "calibrated",
    "calibration_of",
    "open_calibration",
    "save_calibration",
]

_HOMES = {
    "AlignmentFound": "calibration",
    "Calibration": "calibration",
    "Finding": "calibration",
    "Instrument": "calibration",
    "Measured": "calibration",
    "calibrated": "apply",
    "calibration_of": "apply",
    "open_calibration": "file",
    "save_calibration": "file",
}

if not TYPE_CHECKING:  # a type checker would accept any name
    __getattr__, __dir__ = lazily(__name__, _HOMES, __all__)
