"""Triggers of other distributions, whose answers are checked: see `acquire.guarded`."""

from __future__ import annotations

from functools import partial
from numbers import Integral
from typing import TYPE_CHECKING, Any, cast

from acquire.clock import ClockFit
from acquire.errors import TriggerError
from acquire.guarded import Expected, Guarded, checked_call
from acquire.trigger.base import LineTag, TagEvent, Trigger, TriggerIdentity
from acquire.trigger.driver import TriggerDriver

if TYPE_CHECKING:
    from acquire.config import RigConfig
    from acquire.trigger.variant import TriggerVariant


def _is_list_of(kind: type, found: object) -> bool:
    return isinstance(found, list | tuple) and all(isinstance(each, kind) for each in found)


_OPENED = Expected.with_methods(
    Trigger, "identify", "prepare", "start", "tags", "events", "stop", "statistics", "close"
)
_EXPECTED = {
    "identify": Expected.of_type(TriggerIdentity),
    "start": Expected.of_type(ClockFit),
    "tags": Expected(partial(_is_list_of, LineTag), "a list of LineTag"),
    "events": Expected(partial(_is_list_of, TagEvent), "a list of TagEvent"),
    "stop": Expected.of_type(Integral, "the number of pulses"),
    "statistics": Expected.of_type(dict, "a dictionary with pulses and tags"),
}


def open_checked(whose: str, variant: TriggerVariant, config: RigConfig, bench: Any) -> Trigger:
    """Return the trigger of somebody else's driver, ``whose`` in words. Raises TriggerError, UsageError."""
    opened = checked_call(whose, "open", lambda: variant.open(config, bench), _OPENED, TriggerError)
    # Our own driver on their transport: its further methods are used, and it is recognised by its class.
    if isinstance(opened, TriggerDriver):
        return opened
    return cast("Trigger", Guarded(whose, opened, _EXPECTED, TriggerError))
