"""The machine that writes a recording, and its boot: from these, recovery knows what can have been lost.

A machine that has kept running has everything that was written, even what was never forced to the medium.
"""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@cache  # every commit asks, and a process does not outlive a boot
def this_host() -> dict[str, str]:
    """Return the machine's name, and a number that is different after every boot, for a recording's root."""
    try:
        boot_id = _BOOT_ID.read_text(encoding="ascii").strip()
    except FileNotFoundError:
        boot_id = ""  # then no recording counts as written since the start, and recovery checks all of it
    return {"name": platform.node(), "boot_id": boot_id}


def is_here(attributes: Mapping[str, Any]) -> bool:
    """Return whether the recording was written on this machine."""
    name = _host(attributes).get("name")
    return bool(name) and name == this_host()["name"]


def has_run_on(attributes: Mapping[str, Any]) -> bool:
    """Return whether this machine wrote the recording, and has not restarted since."""
    boot_id = _host(attributes).get("boot_id")
    return bool(boot_id) and boot_id == this_host()["boot_id"] and is_here(attributes)


def _host(attributes: Mapping[str, Any]) -> Mapping[str, Any]:
    host = attributes.get("host")
    return host if isinstance(host, dict) else {}
