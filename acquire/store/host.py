"""Which machine writes a recording, since which start of it: who finds it open knows what can have happened.

A machine that has run on has kept everything that was written, also what was never forced to the medium.
"""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@cache
def this_host() -> dict[str, str]:
    """For a recording's root: the machine's name, and a number that is another after every start."""
    try:
        boot_id = _BOOT_ID.read_text(encoding="ascii").strip()
    except FileNotFoundError:
        boot_id = ""
    return {"name": platform.node(), "boot_id": boot_id}


def is_here(attributes: Mapping[str, Any]) -> bool:
    """The recording was written on this machine."""
    name = _host(attributes).get("name")
    return bool(name) and name == this_host()["name"]


def has_run_on(attributes: Mapping[str, Any]) -> bool:
    """This machine wrote the recording, and has not stopped since."""
    boot_id = _host(attributes).get("boot_id")
    return bool(boot_id) and boot_id == this_host()["boot_id"] and is_here(attributes)


def _host(attributes: Mapping[str, Any]) -> Mapping[str, Any]:
    host = attributes.get("host")
    return host if isinstance(host, dict) else {}
