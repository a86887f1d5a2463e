"""The forward model, Eq. (1)–(4): what the lines see of a scene, and the transpose of that."""

from acquire.forward.arms import DualArm
from acquire.forward.merge import block_bounds, hold_video, merge_video
from acquire.forward.tdi import TdiArm

__all__ = ["DualArm", "TdiArm", "block_bounds", "hold_video", "merge_video"]
