"""Recorded lines that are in doubt, and why.

The checks during the recording find lines that do not follow the light's code (`suspect_lines`); the ledger
counts every reason to doubt stored lines (`taint_words`).

A check takes some tenths of a second of lines, and its verdict comes after them: lines written before it are
not flagged. So the recording's events state from which line on the code is in doubt, and from which line on
it is verified again, for each arm::

       check: verified                check: doubtful          check: verified
    ───├──────────────┤───────────────├──────────────┤─── … ───├──────────────┤───
       ▲ code_doubtful                                           code_verified ▲
       └──── the light slipped somewhere here ───────┘

No bad line comes before the first suspect one, which is that of the last verified check: a check may not
notice a slip near its own end.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from acquire.flags import ARMS
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.store.outline import Outline

DOUBTFUL = {arm: f"code_doubtful_{arm}" for arm in ARMS}
"""Arm → kind of the event from whose line on its lines are suspect; its text says why."""
VERIFIED = {arm: f"code_verified_{arm}" for arm in ARMS}
"""Arm → kind of the event from whose line on they follow the code."""
CODE_EVENTS = frozenset((*DOUBTFUL.values(), *VERIFIED.values()))

_TAINTS = {
    "incomplete": "that arrived damaged",
    "unconfirmed": "that no tag of the trigger confirmed",
    "code_contradicted": "against the code",
}


@dataclass(frozen=True, slots=True)
class Suspect:
    """Lines of one arm that do not follow the recorded code, and the check's verdict."""

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
    """Return the suspect lines of both arms, in order. Raises DataError if the events cannot be read."""
    end = recording.first_line + recording.lines
    found: list[Suspect] = []
    for arm in ARMS:
        doubt: tuple[int, str] | None = None
        for event in recording.events:
            if event.kind == DOUBTFUL[arm] and doubt is None:
                doubt = event.line, event.text
            elif event.kind == VERIFIED[arm] and doubt is not None:
                found.append(Suspect(arm, doubt[0], min(event.line, end) - doubt[0], doubt[1]))
                doubt = None
        if doubt is not None:
            found.append(Suspect(arm, doubt[0], end - doubt[0], doubt[1]))
    return tuple(one for one in found if one.count > 0)


def taint_words(counts: Mapping[str, int]) -> list[str]:
    """Return the ledger's ``tainted_by`` in words: reasons of an arm, and names of the trigger's counts."""
    reasons = []
    for name, count in counts.items():
        kind, _, arm = name.rpartition("_")
        if arm in ARMS and kind in _TAINTS:
            reasons.append(f"arm {arm}: {counted(count, 'line')} {_TAINTS[kind]}")
        else:
            reasons.append(f"{name.replace('_', ' ')}: {count}")
    return reasons
