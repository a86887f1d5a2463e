"""A camera's list of settings: written in order, converted to the feature's type, read back, compared.

The values that a GenICam feature accepts depend on others (a selector, a width, a mode), so the user
determines the order, and an error states what the camera accepts at that moment. This module is independent
of GenICam libraries: a camera's driver provides the nodes.
"""

from __future__ import annotations

import difflib
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

from acquire.errors import CameraError
from acquire.text import shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

MODULES = ("remote", "interface", "device", "stream", "system")
"""GenTL modules with features: the camera itself, then the host's side."""

Kind = Literal["integer", "float", "enumeration", "boolean", "text", "command", "other"]
Value = bool | int | float | str

_LONG = 1e15
"""Limits from here on are those of the type, not of the camera, and are shown with few digits."""
COMMAND_S = 5.0
"""Time for the camera to carry out a command."""
FLOAT_TOLERANCE = 1e-3
"""Relative tolerance for the rounding of cameras; a larger difference is another value."""


@dataclass(frozen=True, slots=True)
class Setting:
    """``feature`` of ``module`` shall be ``value``; a command is executed when its value is true."""

    module: str
    feature: str
    value: Value

    def __str__(self) -> str:
        return f"{self.module} {self.feature} = {shown(self.value)}"


def await_done(command: str, is_done: Callable[[], bool]) -> None:
    """Wait until the camera has carried out a command: one that loads settings overwrites what is set before.

    Raises CameraError if it has not after `COMMAND_S`.
    """
    deadline = time.monotonic() + COMMAND_S
    while not is_done():
        if time.monotonic() > deadline:
            raise CameraError(
                f"{command} is not done after {COMMAND_S:g} s",
                possible="the camera may still be carrying it out",
                hint="look up in the camera's manual when it accepts the command",
            )
        time.sleep(0.001)


class Node(Protocol):
    """One feature of a camera, through any library. Access raises CameraError."""

    name: str
    kind: Kind

    @property
    def readable(self) -> bool:
        """Whether it has a value that can be read now; a command has none."""
        ...

    @property
    def writable(self) -> bool:
        """Whether it can be set, or executed, now: many features are locked while lines are taken."""
        ...

    @property
    def selected(self) -> bool:
        """Whether its value depends on a selector."""
        ...

    def read(self) -> Value:
        """Return the value, in the type of its `kind`."""
        ...

    def write(self, value: Value) -> None:
        """Set the value; execute a command and wait, for a bounded time, until it is done."""
        ...

    def limits(self) -> tuple[float, float, float]:
        """Return minimum, maximum, increment (0 for any) of a number."""
        ...

    def entries(self) -> list[str]:
        """Return the names that an enumeration accepts now."""
        ...


class Features(Protocol):
    """The features of one module."""

    def find(self, name: str) -> Node | None:
        """Return the feature of that name; None if the module has none."""
        ...

    def names(self) -> list[str]:
        """Return the names of all features, for guesses at what was meant."""
        ...


def apply_settings(settings: Iterable[Setting], modules: Mapping[str, Features]) -> None:
    """Write every setting in order. Raises CameraError at the first that cannot be applied.

    Each is read back at once; at the end all except selected ones are read again, since a later setting may
    have changed an earlier one.
    """
    written: dict[tuple[str, str], tuple[Setting, Node]] = {}
    for setting in settings:
        node = find_node(setting.module, setting.feature, modules)
        value = coerce(setting, node)
        if not node.writable:
            now = f", it reads {node.read()!r}" if node.readable else ""
            raise CameraError(
                f"{setting}: it cannot be written now{now}",
                hint="first write a setting that unlocks it (a selector or mode), unless it is read-only",
            )
        node.write(value)
        if node.kind != "command":
            _compare(setting, node, "when it is read back")
            written[setting.module, setting.feature] = (setting, node)
    for setting, node in written.values():
        if not node.selected:
            _compare(setting, node, "after a later setting")


def find_node(module: str, feature: str, modules: Mapping[str, Features]) -> Node:
    """Return the feature. Raises CameraError that lists similar ones."""
    if module not in modules:
        raise CameraError(f"the camera has no module {module!r}", possible=", ".join(modules))
    node = modules[module].find(feature)
    if node is not None:
        return node
    names = modules[module].names()
    close = difflib.get_close_matches(feature, names, 5, 0.4)
    elsewhere = [other for other in modules if modules[other].find(feature) is not None]
    hint = f"module {' or '.join(elsewhere)}" if elsewhere else "acquire camera features"
    raise CameraError(
        f"{module} has no feature {feature!r}", possible=", ".join(close or names[:20]), hint=hint
    )


def coerce(setting: Setting, node: Node) -> Value:
    """Convert the value to the feature's type. Raises CameraError for another type, or out of range."""
    value: Value | None = _COERCE[node.kind](setting.value)
    if value is None:
        raise CameraError(f"{setting}: the feature cannot have this value", possible=describe(node))
    if node.kind in ("integer", "float"):
        assert not isinstance(value, str)
        low, high, step = node.limits()
        # As it is: a file may hold an integer that no float can.
        inside = low <= value <= high
        # The camera rounds floats to their steps, but insists on those of integers.
        if not inside or (step and node.kind == "integer" and (value - low) % step):
            raise CameraError(f"{setting}: the value is out of range", possible=describe(node))
    elif node.kind == "enumeration" and value not in node.entries():
        raise CameraError(f"{setting}: the feature has no such entry", possible=describe(node))
    return value


def describe(node: Node) -> str:
    """Return what the feature accepts now, as text."""
    if node.kind in ("integer", "float"):
        low, high, step = node.limits()
        every = f" in steps of {step:g}" if step not in (0, 1) else ""
        return f"{_number(low)} to {_number(high)}{every}"
    if node.kind == "enumeration":
        return ", ".join(node.entries()) or "no entry now"
    return {"boolean": "true, false", "text": "a text", "command": "true: it is executed"}.get(
        node.kind, "nothing that can be set"
    )


def _number(value: float) -> str:
    whole = abs(value) < _LONG and value == round(value)
    return f"{value:.0f}" if whole else f"{value:g}"


def _compare(setting: Setting, node: Node, when: str) -> None:
    if not node.readable:  # some features can only be written: nothing shows what became of the value
        return
    found, wanted = node.read(), coerce_loosely(setting, node)
    if node.kind == "float":
        same = math.isclose(float(found), float(wanted), rel_tol=FLOAT_TOLERANCE)
    else:
        same = found == wanted
    if not same:
        raise CameraError(f"{setting}: the camera has {found!r} {when}", possible=describe(node))


def coerce_loosely(setting: Setting, node: Node) -> Value:
    """Convert a value that `coerce` has accepted, without checking limits, which may have changed since."""
    value: Value | None = _COERCE[node.kind](setting.value)
    assert value is not None
    return value


def _integer(value: Value) -> int | None:
    if isinstance(value, str):
        try:
            return int(value, 0)  # 0: also "0x1f", as manuals give the values of registers
        except ValueError:
            return None
    # The remainder of an infinite value is NaN, which counts as true.
    return None if isinstance(value, bool) or value % 1 else int(value)


def _real(value: Value) -> float | None:
    if isinstance(value, bool):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _boolean(value: Value) -> bool | None:
    return bool(value) if value in (0, 1) else None


def _text(value: Value) -> str | None:
    return value if isinstance(value, str) else None


_COERCE: dict[str, Any] = {
    "integer": _integer,
    "float": _real,
    "enumeration": _text,
    "boolean": _boolean,
    "text": _text,
    "command": _boolean,
    "other": lambda _: None,
}
