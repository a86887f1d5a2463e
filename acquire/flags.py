"""Names of the arms and flags of the lines, shared by every part of the program."""

from __future__ import annotations

from enum import IntFlag

ARMS = ("a", "b")
"""Names of the two arms, in the order of the ``arm`` axis."""


class LineFlag(IntFlag):
    """What is known about one line beyond its pixels (CF ``flag_masks`` of the recording)."""

    MISSING = 1
    """Never arrived; the row is filled with 0."""
    INCOMPLETE = 2
    """Part of the line is not valid, or its number is in doubt because the camera missed triggers."""
    SATURATED = 4
    """At least one pixel is at the top of the range."""
    TIME_ESTIMATED = 8
    """No tag of the trigger confirmed tick and time; they are extrapolated."""
    CODE_UNVERIFIED = 16
    """No tag of the trigger confirmed the code index; it is extrapolated."""
    CODE_CONTRADICTED = 32
    """The arm's lines did not follow the code that they are tagged with (`acquire.stream.lightcheck`)."""


NO_IMAGE = LineFlag.MISSING | LineFlag.INCOMPLETE
"""Flags of lines whose pixels mean nothing: zeros, or in part those of an earlier line."""
