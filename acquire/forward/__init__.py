"""The forward model, Eq. (1)–(4): the lines that a scene produces, and the transpose of that map."""

from acquire.forward.arms import DualArm
from acquire.forward.blurring import Blurring, blur_matrices, blurring, mean_weights
from acquire.forward.gathered import GatheredArms
from acquire.forward.merge import block_bounds, column_merging, hold_video, merge_video
from acquire.forward.registration import (
    Registration,
    interpolation,
    interpolation_variance,
    registration,
)
from acquire.forward.tdi import TdiArm

__all__ = [
    "Blurring",
    "DualArm",
    "GatheredArms",
    "Registration",
    "TdiArm",
    "block_bounds",
    "blur_matrices",
    "blurring",
    "column_merging",
    "hold_video",
    "interpolation",
    "interpolation_variance",
    "mean_weights",
    "merge_video",
    "registration",
]
