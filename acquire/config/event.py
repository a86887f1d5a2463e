"""Models of a rig's ``[events]`` and ``[check]``: what is detected in the lines during capture."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from acquire.config.base import MOST_DN, FrozenModel, Seconds


class EventsConfig(FrozenModel):
    """While armed, an event from one of ``sources`` starts a recording; further events prolong it.

    The level is compared with the mean of the arm's pixels over some lines. A crossing counts once, until the
    mean has gone back by the hysteresis.
    """

    sources: tuple[Literal["mark", "input", "threshold"], ...] = Field(
        default=(),
        description="'mark': acquire mark; 'input': an edge at the trigger's PPS input; 'threshold': the "
        "mean of the pixels crosses level_dn",
    )
    arm: Literal["a", "b"] = Field(default="a", description="'threshold': the arm to observe")
    level_dn: float = Field(default=0.0, ge=0, le=MOST_DN, description="'threshold': mean of the pixels")
    hysteresis_dn: float = Field(
        default=0.0, ge=0, le=MOST_DN, description="amount by which the mean must go back to count again"
    )
    edge: Literal["rising", "falling"] = "rising"
    average_lines: int = Field(default=64, ge=1, le=65536, description="lines over which the mean is taken")
    pre_s: Seconds = Field(default=0.0, description="time recorded before the event, taken from the ring")
    post_s: Seconds = Field(default=1.0, gt=0, description="time recorded after the last event")
    rearm: bool = Field(
        default=False,
        description="true: every event starts a recording, and the instrument stays armed for the next; "
        "false: only the first event after arming does",
    )

    @model_validator(mode="after")
    def _level_known(self) -> EventsConfig:
        # A level within the hysteresis of 0 could rise once and never again: no mean goes below 0.
        if "threshold" in self.sources and not self.hysteresis_dn < self.level_dn:
            raise ValueError("source 'threshold' needs a level_dn above hysteresis_dn")
        return self


class CheckConfig(FrozenModel):
    """Check from the lines themselves that the light follows the code. Doubtful lines are flagged, and kept.

    The pixels of each arm predict the energy of the other, so that the arms are checked against each other to
    the sub-step. A known offset between the images, in fine pixels, is entered here.
    """

    enable: bool = True
    registration_a: int = Field(
        default=0, ge=-64, le=64, description="sub-steps by which the image of arm a is late"
    )
    registration_b: int = Field(
        default=0, ge=-64, le=64, description="sub-steps by which the image of arm b is late"
    )
