"""Reload of the rig file while the service works: permitted changes are applied, all others are refused.

::

    read      the file, with the options that the daemon was started with; checked as at the start
    compare   with the daemon's configuration, key by key
    refuse    everything if one key cannot change: file and daemon must not drift apart
    apply     in the thread that owns the devices, between two commands

Values that are read when they are needed, such as at the end of a recording or by the next hook, can change.
Those that devices, rings, a running capture and recordings were created with cannot.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from acquire.config.service import WHOLE, public_url
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
    "recording.reserve_gb": f"{NEXT_RECORDING}, and for copies at once",
    "recording.retention": NEXT_RECORDING,
    "service.begin": NEXT_START,
    "service.log_level": AT_ONCE,
    "service.retry_s": NEXT_START,
    "web": AT_ONCE,
}
"""Table or key → when the new value takes effect."""
MOST_LISTED = 10
"""Number of keys that an error lists."""

log = logging.getLogger("acquire.daemon")


class Reloading:
    """`read` in any thread, then `apply` in the one that owns the devices."""

    def __init__(self, read: Callable[[], RigConfig], service: Service, hooks: Hooks) -> None:
        """``read`` raises ConfigError for a file that the daemon would not start with."""
        self._read, self._service, self._hooks = read, service, hooks

    def read(self, who: str) -> RigConfig:
        """Return the configuration in the file. Errors in it are reported, and nothing is changed."""
        try:
            return self._read()
        except AcquireError as error:
            self._report(f"reload by {who}: nothing was changed: {error}", refused=True)
            raise

    def apply(self, new: RigConfig, who: str) -> Reloaded:
        """Apply the changes. Raises UsageError, listing keys that cannot change, before changing anything."""
        service = self._service
        changed = changes(service.config, new)
        if fixed := [one for one in changed if not one.holds]:
            error = refusal(fixed)
            self._report(f"reload by {who}: nothing was changed: {error}", refused=True)
            raise error
        text = "; ".join(f"{words(one)} ({one.holds})" for one in changed)
        text = f"reload by {who}: {text or 'the file has not changed'}"
        if changed:
            service.reconfigure(new, shortened(text, LONGEST_MARK))
            self._hooks.reconfigure(new.hooks)
        # Log at the more verbose of the two levels, so that the change itself is in the log.
        root, level = logging.getLogger(), new.service.level
        root.setLevel(min(root.level, level))
        self._report(text)
        root.setLevel(level)
        return Reloaded(file=service.origin, changed=changed)

    def _report(self, text: str, *, refused: bool = False) -> None:
        log.log(logging.WARNING if refused else logging.INFO, "%s", text)
        self._service.news.add("reload", text, level="warning" if refused else "info")


def changes(old: RigConfig, new: RigConfig) -> list[ChangedKey]:
    """Return every dotted key whose value differs; for an added or removed table, the table."""
    # With the secrets, without which a change of only these would not be noticed.
    whole = (one.model_dump(mode="json", context=WHOLE) for one in (old, new))
    changed = list(_differences("", *whole))
    for number, one in enumerate(changed):
        # Without the secrets of its URLs: changes are noted in the log and in recordings.
        if one.key == "hooks.webhook":
            public = {which: url and public_url(url) for which, url in (("old", one.old), ("new", one.new))}
            changed[number] = one.model_copy(update=public)
    return changed


def _differences(key: str, old: Any, new: Any) -> Iterator[ChangedKey]:
    if isinstance(old, dict) and isinstance(new, dict):
        for name in sorted(old.keys() | new.keys()):
            yield from _differences(f"{key}.{name}".lstrip("."), old.get(name), new.get(name))
    elif old != new:
        # With the dot, so that `web` allows `web.port` and not `website`.
        holds = next((when for may, when in MAY_CHANGE.items() if f"{key}.".startswith(f"{may}.")), "")
        yield ChangedKey(key=key, old=old, new=new, holds=holds)


def words(one: ChangedKey) -> str:
    """Return the change of a key as text, new value first."""
    return f"{one.key} = {shown(one.new)}, it was {shown(one.old)}"


def refusal(fixed: list[ChangedKey]) -> UsageError:
    """Return the error for keys that only a restart can change; it lists at most `MOST_LISTED` of them."""
    listed = "; ".join(words(one) for one in fixed[:MOST_LISTED])
    more = f"; and {len(fixed) - MOST_LISTED} more" if len(fixed) > MOST_LISTED else ""
    return UsageError(
        f"the daemon cannot change these while it runs: {listed}{more}",
        possible=f"changes of {', '.join(MAY_CHANGE)}",
        hint="restart the daemon while it is idle, or revert these changes in the file",
    )
