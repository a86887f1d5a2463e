"""Models of a rig's ``[events]`` and ``[check]``: what is looked for in the lines while they pass."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from acquire.config.base import MOST_DN, FrozenModel, Seconds


class EventsConfig(FrozenModel):
    """While armed, an event of one of ``sources`` starts a recording; while that is written, it prolongs it.

    The level is the mean of the arm's pixels over some lines. It counts as crossed once, until it has gone
    back by the hysteresis.
    """

    sources: tuple[Literal["mark", "input", "threshold"], ...] = Field(
        default=(),
        description="'mark': acquire mark; 'input': an edge at the trigger's PPS input; 'threshold': level",
    )
    arm: Literal["a", "b"] = Field(default="a", description="'threshold': whose lines")
    level_dn: float = Field(default=0.0, ge=0, le=MOST_DN, description="'threshold': mean of the pixels")
    hysteresis_dn: float = Field(
        default=0.0, ge=0, le=MOST_DN, description="by which it must go back to count again"
    )
    edge: Literal["rising", "falling"] = "rising"
    average_lines: int = Field(default=64, ge=1, le=65536, description="lines that the mean is taken over")
    pre_s: Seconds = Field(default=0.0, description="recorded from before the event, as the ring has it")
    post_s: Seconds = Field(default=1.0, gt=0, description="recorded after the last event")
    rearm: bool = Field(
        default=False,
        description="every event starts a recording, and the instrument stays armed for the next; "
        "false: only the first event since it was armed",
    )

    @model_validator(mode="after")
    def _level_known(self) -> EventsConfig:
        if "threshold" in self.sources and not self.hysteresis_dn < self.level_dn:
            raise ValueError("source 'threshold' needs a level_dn above hysteresis_dn")
        return self


class CheckConfig(FrozenModel):
    """Whether the light follows the code, by the lines themselves. Lines in doubt are flagged, never dropped.

    Each arm's pixels predict the other's energy, so that the arms are checked against each other to the
    sub-step. Images known to lie off one another by some fine pixels are told here.
    """

    enable: bool = True
    registration_a: int = Field(default=0, ge=-64, le=64, description="sub-steps by which arm a shows late")
    registration_b: int = Field(default=0, ge=-64, le=64, description="sub-steps by which arm b shows late")
