"""Reconstruction: from cut lines to a video, with the priors that fill what the lines leave open.

::

    a call         api ──▶ result        options, clock, compiling, feasibility: what it may cost
                    │
    the problem    problem               holdout, outliers: which samples judge, and which do not count
                    │                    basis, band, views: the operator, from coefficients to lines
                  given                  what a solver is given
                    │
    solvers        solver                the interface; solve, twist: the paper's, and a known image
                    │
    the default    choose                which prior predicts best; reuse: that of another part of the scene
                    ├─ following         what moves as one, on a path that is read off a video
                    ├─ workbench         trials of candidates: still, volume, cycle, brightness; spectrum:
                    │                    of what flows; chosen: the best of them
                    └─ blinking          cosines: bandwidth, lamps, pursuit
                        └─ patterns      with curves; evidence, settling, darkness; beside_motion,
                                         joined
    iterations     admm                  sign, tv, volume, smooth, ground, drift, bends, rotation,
                                         denoisers, kernels: proximal steps
                    │
    judgement      estimates             what any solver returns
                    ├─ judge             residuals and warnings; sanity, aliasing, unseen
                    ├─ error_estimation  how far from the truth; error
                    └─ description_check whether code and geometry are right; diagnosis, search, hypotheses,
                                         gaussian, balance
    long videos    segments              sub-segments, and one grid for all; auto: voxels by the tempo

Where to begin: `api.reconstruct`, then `choose`, whose docstring lists the priors.
"""

from acquire.recon.api import reconstruct
from acquire.recon.basis import TemporalBasis
from acquire.recon.denoisers import Denoiser, HaarShrink
from acquire.recon.result import Look, Progress, Quality, Reconstruction
from acquire.recon.solver import Preset, Solver

__all__ = [
    "Denoiser",
    "HaarShrink",
    "Look",
    "Preset",
    "Progress",
    "Quality",
    "Reconstruction",
    "Solver",
    "TemporalBasis",
    "reconstruct",
]
