"""What an instrument is, measured: from recordings of known light to what the reconstruction corrects.

::

    recordings ──▶ exposure ──▶ dark, flat, transfer, orientation, align ──▶ Finding
                                                                              │
    recording's copy ◀── Calibration ◀── file (Zarr group) ◀── with_step ◀────┘
                             │
                             └──▶ apply: a segment's offsets, responsivities, mask, alignment

A calibration holds what was measured and nothing else; what it does not hold is not corrected. Lines on disk
are never altered.
"""

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
