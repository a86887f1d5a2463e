"""The rig that replays a recording: made from what the recording says of its lines.

Devices, uploads, retention, events and the ring of the rig that recorded it are of no matter: only the lines,
their code and their clock are replayed. So any recording will do, of any version and with any devices.
"""

from __future__ import annotations

import math
import os
import shutil
from typing import TYPE_CHECKING, Any

from acquire.config.device import PIXEL_BITS
from acquire.errors import UsageError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.fibre import Fibre
    from acquire.store import Recording

BLOCK_BYTES = 2**20
"""Of pixels in a block of lines, at most."""
MOST_BLOCK_LINES = 256
MEMORY_SHARE = 4
"""Of the memory that is free, one part in so many may hold lines of both arms."""
SHARED_MEMORY = "/dev/shm"  # noqa: S108  # where the system keeps it; nothing is written there by name
MOST_SLOTS = 2**16
SPARE_SLOTS = 16
PATIENCE_S = 120.0
"""Of silence: on a busy host a process may not run for seconds, and none of these devices can fail."""


def replay_rig(stored: Recording, speed: float, directory: Path, **simulation: Any) -> dict[str, Any]:
    """A rig file's table. Raises UsageError for a recording that no simulated rig can replay."""
    geometry = stored.attrs["geometry"]
    fibre = stored.fibre
    if fibre is None and geometry["pixels"] != geometry["stages"]:
        raise UsageError(
            f"{stored} cannot be replayed: its lines have {geometry['pixels']} pixels",
            possible=f"as many as stages, {geometry['stages']}",
        )
    substeps = stored.substeps
    block = max(1, min(MOST_BLOCK_LINES, BLOCK_BYTES // line_bytes(stored)))
    slots = _slots(stored, block)
    # As it was recorded, within what a rig may ask for.
    chunk_lines = min(2**20, max(16, stored.camera("a").reader("lines").shape.chunk_rows))
    return {
        "name": "replay",
        "geometry": {"stages": geometry["stages"], "substeps": substeps},
        "code": _code(stored),
        "trigger": {
            "clock_hz": stored.clock.clock_hz,
            "substep_ticks": stored.attrs["trigger"]["line_period_ticks"] // substeps,
            "tag_every_lines": max(1, min(256, slots * block // 4)),
        },
        "cameras": {arm: _camera(stored, arm) for arm in ARMS}
        | ({} if fibre is None else {"layout": "fibre"}),
        "fibre": _table(fibre),
        "stream": {"block_lines": block, "ring_slots": slots, "reopen_s": PATIENCE_S},
        "recording": {"directory": str(directory), "chunk_lines": chunk_lines, "reserve_gb": 0.0},
        "simulation": {"speed": speed, "replay": str(stored.path.resolve()), **simulation},
    }


def _table(fibre: Fibre | None) -> dict[str, Any] | None:
    if fibre is None:
        return None
    return {
        "rows": fibre.rows,
        "columns": fibre.columns,
        "sensor_pixels": fibre.sensor_pixels,
        "bands_a": fibre.bands_a,
        "bands_b": fibre.bands_b,
    }


def line_bytes(stored: Recording) -> int:
    """Of one arm."""
    return stored.camera("a").pixels * stored.camera("a").dtype.itemsize


def _slots(stored: Recording, block_lines: int) -> int:
    """A ring that holds the whole recording, where memory allows it: however busy the host, no line is lost.

    A gap ends a block, so that every gap takes a slot.
    """
    needed = math.ceil(stored.lines / block_lines) + len(stored.gaps) + SPARE_SLOTS
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if os.path.isdir(SHARED_MEMORY):  # noqa: PTH112  # a path of the system's
        free = min(free, shutil.disk_usage(SHARED_MEMORY).free)
    possible = free // MEMORY_SHARE // (2 * block_lines * line_bytes(stored))
    return max(SPARE_SLOTS, min(needed, possible, MOST_SLOTS))


def _code(stored: Recording) -> dict[str, Any]:
    """The recorded code from its first line on."""
    from acquire.sim.replay import replay_code

    code = replay_code(stored).to_attrs()
    if code["kind"] == "prbs":
        return {"kind": "prbs", "degree": code["degree"], "state": code["state"]}
    return {"kind": "constant", "value": code["value"]}


def _camera(stored: Recording, arm: str) -> dict[str, Any]:
    """The camera whose samples these are: the smallest format that holds its white."""
    facts = stored.attrs["cameras"][arm]
    wide = stored.camera(arm).dtype.itemsize > 1
    bits = {name: count for name, count in PIXEL_BITS.items() if (count > 8) == wide}
    fitting = [name for name, count in bits.items() if 2**count > facts["white_dn"]]
    if not fitting:
        raise UsageError(
            f"{stored} cannot be replayed: white of arm {arm} is {facts['white_dn']} DN",
            possible=f"up to {2 ** max(bits.values()) - 1} for {stored.camera(arm).dtype} samples",
        )
    return {
        "serial": arm,
        "pixel_format": fitting[0],
        "black_level_dn": facts["black_level_dn"],
        "responsivity_dn": facts["responsivity_dn"],
    }
