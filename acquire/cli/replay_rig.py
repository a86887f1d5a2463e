"""The rig file that replays a recording, made from the recording's own description.

Only the lines, their code and their clock are replayed. The devices, uploads, retention, events and ring of
the original rig do not matter, so recordings of any version and with any devices can be replayed.
"""

from __future__ import annotations

import math
import os
import shutil
from typing import TYPE_CHECKING, Any

from acquire.config.device import PIXEL_BITS
from acquire.config.rig import MOST_TAGS_PER_S
from acquire.errors import UsageError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.store import Recording

BLOCK_BYTES = 2**20
"""Largest size of the pixels in a block of lines."""
MOST_BLOCK_LINES = 256
MEMORY_SHARE = 4
"""The rings of both arms may take up to 1/4 of the free memory."""
SHARED_MEMORY = "/dev/shm"  # noqa: S108  # only its free space is read; nothing is written there by name
MOST_SLOTS = 2**16
SPARE_SLOTS = 16
"""Slots in addition to those for the recording, and the fewest if memory is short."""
PATIENCE_S = 120.0
"""Longest silence of a device: a process may not run for seconds on a busy host, but no device can fail."""


def replay_rig(stored: Recording, speed: float, directory: Path, **simulation: Any) -> dict[str, Any]:
    """Return the table of a rig file. Raises UsageError for a recording that no simulated rig can replay."""
    from acquire.sim.replay import replay_code

    geometry = stored.attrs["geometry"]
    fibre = stored.fibre
    if fibre is None and geometry["pixels"] != geometry["stages"]:
        raise UsageError(
            f"{stored} cannot be replayed: its lines have {geometry['pixels']} pixels",
            possible=f"as many pixels as stages, {geometry['stages']}",
        )
    line_period_ticks = stored.attrs["trigger"]["line_period_ticks"]
    code = replay_code(stored).to_attrs()  # from the first recorded line on
    keys = ("degree", "state") if code["kind"] == "prbs" else ("value",)
    substeps = stored.substeps
    block = max(1, min(MOST_BLOCK_LINES, BLOCK_BYTES // line_bytes(stored)))
    slots = _slots(stored, block)
    # As in the original, within the limits of a rig file.
    chunk_lines = min(2**20, max(16, stored.camera("a").reader("lines").shape.chunk_rows))
    table: dict[str, Any] = {
        "name": "replay",
        "geometry": {"stages": geometry["stages"], "substeps": substeps},
        "code": {
            "kind": "prbs" if code["kind"] == "prbs" else "constant",
            **{key: code[key] for key in keys},
        },
        "trigger": {
            "clock_hz": stored.clock.clock_hz,
            "substep_ticks": line_period_ticks // substeps,
            # A rig file allows at most a third of the ring, and only as many tags as the host can read.
            "tag_every_lines": max(
                min(256, slots * block // 4),
                math.ceil(speed * stored.clock.clock_hz / line_period_ticks / MOST_TAGS_PER_S),
            ),
        },
        "cameras": {arm: _camera(stored, arm) for arm in ARMS},
        "stream": {"block_lines": block, "ring_slots": slots, "reopen_s": PATIENCE_S},
        "recording": {"directory": str(directory), "chunk_lines": chunk_lines, "reserve_gb": 0.0},
        "simulation": {"speed": speed, "replay": str(stored.path.resolve()), **simulation},
    }
    if fibre is not None:
        names = ("rows", "columns", "sensor_pixels", "bands_a", "bands_b")
        table["cameras"]["layout"] = "fibre"
        table["fibre"] = {name: getattr(fibre, name) for name in names}
    return table


def line_bytes(stored: Recording) -> int:
    """Return the size of a line of one arm."""
    return stored.camera("a").pixels * stored.camera("a").dtype.itemsize


def _slots(stored: Recording, block_lines: int) -> int:
    """Size the ring to hold the whole recording if memory allows, so that even a busy host loses no lines.

    A gap ends a block, so every gap takes an extra slot.
    """
    needed = math.ceil(stored.lines / block_lines) + len(stored.gaps) + SPARE_SLOTS
    # Of what is free now; what other programs could release is not counted on.
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if os.path.isdir(SHARED_MEMORY):  # noqa: PTH112  # a fixed path of the system
        free = min(free, shutil.disk_usage(SHARED_MEMORY).free)
    possible = free // MEMORY_SHARE // (2 * block_lines * line_bytes(stored))
    return max(SPARE_SLOTS, min(needed, possible, MOST_SLOTS))


def _camera(stored: Recording, arm: str) -> dict[str, Any]:
    """Return a camera for the recorded samples, with the smallest pixel format that holds their white."""
    facts = stored.attrs["cameras"][arm]
    wide = stored.camera(arm).dtype.itemsize > 1
    # Formats of up to 8 bits take one byte for a sample, all others two.
    bits = {name: count for name, count in PIXEL_BITS.items() if (count > 8) == wide}
    fitting = [name for name, count in bits.items() if 2**count > facts["white_dn"]]
    if not fitting:
        raise UsageError(
            f"{stored} cannot be replayed: the white level of arm {arm} is {facts['white_dn']} DN",
            possible=f"up to {2 ** max(bits.values()) - 1} DN for {stored.camera(arm).dtype} samples",
        )
    return {
        "serial": arm,
        "pixel_format": fitting[0],
        "black_level_dn": facts["black_level_dn"],
        "responsivity_dn": facts["responsivity_dn"],
    }
