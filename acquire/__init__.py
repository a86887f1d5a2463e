"""Instrument software for TDI-based compressed video.

The way of the data is one direction::

    scene -> forward -> simulated devices -+
    trigger (FPGA) -> tags ----------------+-> ring -> tagger -> writer -> Zarr -> cut -> reconstruct -> video
    camera A, B -> blocks of lines --------+

The layers, top to bottom; imports point downwards only (checked by the tests)::

    cli                              commands: one file per group
    web                              the operator's page, a process of its own
    client                           the service from a script, blocking or awaited
    daemon        evaluate           the capture service · metrics, report
    rig           reconstruct        config -> devices · recording -> video
    capacity      exchange           what this host captures without a loss · files of other programs
    calibrate                        what an instrument is, measured
    sim           recon              simulated devices · solvers, priors
    stream        forward            capture path · Eq. (1)-(4) of the paper and their adjoints
    store  camera  trigger           recording format · device protocols
    config  lines  processes         what a rig is · what travels from camera to disk · children
    codes  geometry  clock           the code, the shear, the time: plain arithmetic
    arrays  cores                    whose arrays are computed with, and on how many cores
    logs  reading                    one line per entry · files that anybody may have put there
    errors  text                     failures that a user can meet, with exit codes · foreign text

Equation numbers in docstrings refer to Li, Wang and Liu, "TDI-based continuous window compressed
spatio-temporal imaging capable of flexible voxels post-interpretation".
"""

__version__ = "0.1.0"
