"""Lines that are there and do not follow the light's code, as far as the check while recording could tell.

A check takes some tenths of a second of lines, and its verdict comes after them: lines that were written
before it carry no flag. So the recording's events say from which line on the code is in doubt, and from which
it is verified again, for each arm::

       check: verified                check: doubtful          check: verified
    ───├──────────────┤───────────────├──────────────┤─── … ───├──────────────┤───
       ▲ code_doubtful                                           code_verified ▲
       └──── the light slipped somewhere here ───────┘

No bad line comes before the first suspect one: a check may not notice what happens near its own end.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from acquire.flags import ARMS

if TYPE_CHECKING:
    from acquire.store.outline import Outline

DOUBTFUL = {arm: f"code_doubtful_{arm}" for arm in ARMS}
"""Arm → kind of the event from whose line on its lines are suspect; its text says why."""
VERIFIED = {arm: f"code_verified_{arm}" for arm in ARMS}
"""Arm → kind of the event from whose line on they follow the code."""
CODE_EVENTS = frozenset((*DOUBTFUL.values(), *VERIFIED.values()))


@dataclass(frozen=True, slots=True)
class Suspect:
    """Lines of one arm that do not follow the recorded code, and what the check said of them."""

    arm: str
    first_line: int
    count: int
    why: str

    def __str__(self) -> str:
        last = self.first_line + self.count - 1
        return f"{self.arm}: lines {self.first_line} to {last} do not follow the light's code: {self.why}"

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def suspect_lines(recording: Outline) -> tuple[Suspect, ...]:
    """Of both arms, in their order. Raises DataError where the events cannot be read."""
    return tuple(found for arm in ARMS for found in _of_arm(recording, arm))


def _of_arm(recording: Outline, arm: str) -> list[Suspect]:
    end = recording.first_line + recording.lines
    found: list[Suspect] = []
    doubt: tuple[int, str] | None = None
    for event in recording.events:
        if event.kind == DOUBTFUL[arm] and doubt is None:
            doubt = event.line, event.text
        elif event.kind == VERIFIED[arm] and doubt is not None:
            found.append(Suspect(arm, doubt[0], min(event.line, end) - doubt[0], doubt[1]))
            doubt = None
    if doubt is not None:
        found.append(Suspect(arm, doubt[0], end - doubt[0], doubt[1]))
    return [one for one in found if one.count > 0]
