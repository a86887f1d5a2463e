"""Instrument software for TDI-based compressed video.

Data flows in one direction::

    scene -> forward -> simulated devices -+
    trigger (FPGA) -> tags ----------------+-> ring -> tagger -> writer -> Zarr -> cut -> reconstruct -> video
    camera A, B -> blocks of lines --------+

The layers, top to bottom; imports point downwards only (checked by the tests)::

    cli           testing            commands: one file per group · public test suites for variants
    web           bluesky            the operator's page, a separate process · the recorder in plans
    client                           the service from a script, blocking or awaited
    daemon        evaluate           the capture service · metrics, report
    rig           reconstruct        config -> devices · recording -> video
    simulate      capacity           scene -> recording · the loss-free rate of this host
    exchange                         files of other programs
    calibrate                        measured properties of an instrument
    sim           recon              simulated devices · solvers, priors
    stream        forward            capture path · Eq. (1)-(4) of the paper and their adjoints
    store  camera trigger            recording format · device protocols
    pattern                          test lines determined by their numbers alone
    config lines  processes          configuration · lines from camera to disk · child processes
    fibre                            position of a larger scene's bands on the sensors
    codes  geometry  clock  flags    the code, the shear, the time: plain arithmetic · flags of lines
    alignment  blur                  position and sharpness of the arms' images
    converter  noise                 a camera's non-linearity and noise
    arrays cores  loops   reading    array back ends · cores · compiled loops · safe reading of foreign files
    logs   plugins  showing scratch  log entries · classes of entry points · reprs · a run's directory
    guarded                          objects of plug-ins, whose calls are checked
    errors text   lazy   place       errors with exit codes · foreign text · late imports · fixed paths

`GLOSSARY.md`, next to this file, defines the terms; `DECISIONS.md` gives the reasons for the design and the
alternatives that were considered.

Equation numbers in docstrings refer to Li, Wang and Liu, "TDI-based continuous window compressed
spatio-temporal imaging capable of flexible voxels post-interpretation".
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.lazy import lazily

if TYPE_CHECKING:
    from acquire.client import Client
    from acquire.config import load_rig, load_scene
    from acquire.store import open_recording, open_video

__version__ = "0.1.0"
__all__ = ["Client", "__version__", "load_rig", "load_scene", "open_recording", "open_video"]

_HOMES = {
    "Client": "client",
    "load_rig": "config",
    "load_scene": "config",
    "open_recording": "store",
    "open_video": "store",
}
"""Public name → the package that defines it, imported on first use since each brings its libraries."""

if not TYPE_CHECKING:  # a type checker would accept any name
    __getattr__, __dir__ = lazily(__name__, _HOMES, __all__)
