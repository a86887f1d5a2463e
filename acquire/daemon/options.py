"""The options of `arm` and `start` as keywords: named, typed and, for the command line, explained once.

::

    StartOptions ─┬─ client.start(duration_s=2)     both clients, checked by a type checker
                  ├─ acquire start --duration 2s    the options of the command and their help
                  └─ StartRequest                   the message, with limits and defaults

An absent option has the default of the message. Durations end in ``_s`` and are in seconds. A test compares
the options with the fields of the messages, which are apart from them because pydantic takes longer to load
than the command's help takes to appear.
"""

# Annotations are not postponed here: the command line reads each `Help` without evaluating the types of
# messages, which it has not loaded.
from collections.abc import Iterable
from dataclasses import dataclass
from inspect import Parameter, Signature
from typing import TYPE_CHECKING, Annotated, Literal, TypedDict

if TYPE_CHECKING:
    from acquire.daemon.messages import TriggerDelays, TriggerWindow

LightCode = Literal["rig", "dark", "steady"]
"""What the light follows in a run: the rig's code, or constantly off or on, for calibrations."""


@dataclass(frozen=True, slots=True)
class Help:
    """Makes an option one of the command line, where its name has no unit, and explains it there."""

    text: str


class ArmOptions(TypedDict, total=False):
    """Options of arming; see `acquire.daemon.messages.ArmRequest`."""

    force: Annotated[bool, Help("Arm even if this host is too slow or the store for uploads denies access.")]
    code: Annotated[
        LightCode,
        Help("Light: rig (follow the rig's code), dark (stay off) or steady (stay on). Default: rig."),
    ]
    calibration: Literal["rig", "none"]
    delays: "TriggerDelays | None"
    window: "TriggerWindow | None"


class StartOptions(TypedDict, total=False):
    """How much to record; see `acquire.daemon.messages.StartRequest`, which also has the path."""

    lines: Annotated[int | None, Help("End after this number of lines. Default: at `acquire stop`.")]
    duration_s: Annotated[
        float | None,
        Help("End after this time, such as 5s, 500ms or 2min. Default: at `acquire stop`."),
    ]
    pre_s: Annotated[
        float,
        Help(
            "Begin this long before the command, with lines that are still in the ring buffers. "
            "Default: with the next line."
        ),
    ]
    post_s: Annotated[
        float | None,
        Help("End this long after the command, regardless of --pre. Default: at `acquire stop`."),
    ]
    resume: Annotated[bool, Help("Continue a sealed RECORDING in a new segment next to it.")]


def one_by_one(own: Signature, options: Iterable[Parameter]) -> Signature:
    """Return a signature with ``options`` in place of its ``**options``, before its other keywords."""
    *others, _ = own.parameters.values()
    return own.replace(parameters=sorted([*options, *others], key=lambda parameter: parameter.kind))
