"""Reconstruction: from cut lines to a video, with the priors that fill what the lines leave open."""

from acquire.recon.api import Progress, Quality, Reconstruction, reconstruct
from acquire.recon.basis import TemporalBasis

__all__ = ["Progress", "Quality", "Reconstruction", "TemporalBasis", "reconstruct"]
