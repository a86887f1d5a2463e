"""Reconstruction: from cut lines to a video, with the priors that fill what the lines leave open."""

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
