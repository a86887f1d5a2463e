"""The forward model, Eq. (1)–(4): what the lines see of a scene, and the transpose of that."""

from acquire.forward.arms import DualArm
from acquire.forward.gathered import GatheredArms
from acquire.forward.merge import block_bounds, column_merging, hold_video, merge_video
from acquire.forward.registration import Registration, registration
from acquire.forward.tdi import TdiArm

__all__ = [
    "DualArm",
    "GatheredArms",
    "Registration",
    "TdiArm",
    "block_bounds",
    "column_merging",
    "hold_video",
    "merge_video",
    "registration",
]
