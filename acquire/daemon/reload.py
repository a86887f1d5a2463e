"""The rig file read anew while the service works: what may change is applied, all else is refused.

::

    read      the file, with the options that the daemon was started with; checked like at the start
    compare   with what the daemon works with, key by key
    refuse    all of it, where one key cannot change: the file and the daemon must not drift apart
    apply     in the thread that owns the devices, between two commands

Who reads a value when it is needed, as the end of a recording or the next hook, sees the new one. What
devices, rings, a capture under way and recordings are made of cannot change.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from acquire.daemon.facts import ChangedKey, Reloaded
from acquire.daemon.messages import LONGEST_MARK
from acquire.errors import AcquireError, UsageError
from acquire.text import shortened, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.config import RigConfig
    from acquire.daemon.hooks import Hooks
    from acquire.daemon.service import Service

AT_ONCE, NEXT_RECORDING, NEXT_START = "at once", "from the next recording on", "when the service starts next"
MAY_CHANGE = {
    "hooks": AT_ONCE,
    "recording.after": AT_ONCE,
    "recording.reserve_gb": NEXT_RECORDING,
    "recording.retention": NEXT_RECORDING,
    "service.begin": NEXT_START,
    "service.log_level": AT_ONCE,
    "service.retry_s": NEXT_START,
    "web": AT_ONCE,
}
"""Table or key → when the new value holds."""
MOST_TOLD = 10
"""Keys that an error lists."""

log = logging.getLogger("acquire.daemon")


class Reloading:
    """`read` in any thread, then `apply` in the one that owns the devices."""

    def __init__(self, read: Callable[[], RigConfig], service: Service, hooks: Hooks) -> None:
        """``read`` raises ConfigError for a file that the daemon would not start with."""
        self._read, self._service, self._hooks = read, service, hooks

    def read(self, who: str) -> RigConfig:
        """The configuration as the file has it now. What is wrong with it is told, and changes nothing."""
        try:
            return self._read()
        except AcquireError as error:
            self._tell(f"reload by {who}: nothing was changed: {error}", refused=True)
            raise

    def apply(self, new: RigConfig, who: str) -> Reloaded:
        """Raises UsageError, with every key that cannot change, before anything is changed."""
        service = self._service
        changed = changes(service.config, new)
        if fixed := [one for one in changed if not one.holds]:
            error = refusal(fixed)
            self._tell(f"reload by {who}: nothing was changed: {error}", refused=True)
            raise error
        told = "; ".join(f"{words(one)} ({one.holds})" for one in changed)
        told = f"reload by {who}: {told or 'the file says what it said before'}"
        if changed:
            service.reconfigure(new, shortened(told, LONGEST_MARK))
            self._hooks.reconfigure(new.hooks)
        # Told at the more talkative of the two levels, so that the change itself is in the log.
        root, level = logging.getLogger(), new.service.level
        root.setLevel(min(root.level, level))
        self._tell(told)
        root.setLevel(level)
        return Reloaded(file=service.origin, changed=changed)

    def _tell(self, text: str, *, refused: bool = False) -> None:
        log.log(logging.WARNING if refused else logging.INFO, "%s", text)
        self._service.news.tell("reload", text, level="warning" if refused else "info")


def changes(old: RigConfig, new: RigConfig) -> list[ChangedKey]:
    """Every key whose value differs, dotted; of a table that comes or goes, the table."""
    return list(_differences("", old.model_dump(mode="json"), new.model_dump(mode="json")))


def _differences(key: str, old: Any, new: Any) -> Iterator[ChangedKey]:
    if isinstance(old, dict) and isinstance(new, dict):
        for name in sorted(old.keys() | new.keys()):
            yield from _differences(f"{key}.{name}".lstrip("."), old.get(name), new.get(name))
    elif old != new:
        holds = next((when for may, when in MAY_CHANGE.items() if f"{key}.".startswith(f"{may}.")), "")
        yield ChangedKey(key=key, old=old, new=new, holds=holds)


def words(one: ChangedKey) -> str:
    return f"{one.key} = {shown(one.new)}, it was {shown(one.old)}"


def refusal(fixed: list[ChangedKey]) -> UsageError:
    told = "; ".join(words(one) for one in fixed[:MOST_TOLD])
    more = f"; and {len(fixed) - MOST_TOLD} more" if len(fixed) > MOST_TOLD else ""
    return UsageError(
        f"cannot change while the service works: {told}{more}",
        possible=f"changes of {', '.join(MAY_CHANGE)}",
        hint="end the service when it is idle and start it anew, or take these back in the file",
    )
