"""Check that this host has what a rig needs: a directory, room on its disk, and memory.

A rig that would fail at `start`, after the devices were armed, is refused before the daemon begins.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acquire.clock import ClockFit
from acquire.config import check_directory, load_scene
from acquire.daemon.storage import storage_settings
from acquire.errors import ConfigError, UsageError
from acquire.lines import ARMS
from acquire.store import RecordingSpec
from acquire.store.codecs import configured_codec

if TYPE_CHECKING:
    from acquire.config import RigConfig

MEMORY_PART = 0.8
"""Share of the host's memory that may be used; the rest is for the system and other programs."""
SIMULATING = 3
"""Processes that hold a simulated scene: the daemon, to check it, and a camera for each arm."""
SCENE_BYTES = 32
"""Measured bytes per fine pixel of a simulated scene in each of them, with four LEDs or with frames."""
_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def check_host(config: RigConfig) -> None:
    """Raise ConfigError if the rig cannot be recorded on this host, stating what could be."""
    check_directory(config)
    recording = config.recording
    total_gb = shutil.disk_usage(recording.directory).total / 1e9
    if not total_gb:  # such as /proc, or a file system that does not know its size
        raise ConfigError(
            f"recording.directory: the disk of {recording.directory.absolute()} has no room at all: "
            "its file system states a size of 0 bytes",
            hint="a directory on a disk",
        )
    if recording.reserve_gb >= total_gb:
        raise ConfigError(
            f"recording.reserve_gb = {recording.reserve_gb:g}: the disk of {recording.directory.absolute()} "
            f"has {total_gb:.3g} GB in all",
            possible=f"from 0 on, and below {total_gb:.3g}",
        )
    retention = recording.retention
    line_bytes = config.pixels * np.dtype(config.cameras.a.dtype).itemsize
    shard_gb = len(ARMS) * config.chunk_lines * recording.shard_chunks * line_bytes / 1e9
    if retention is not None and retention.max_gb is not None and retention.max_gb < shard_gb:
        raise ConfigError(
            f"recording.retention.max_gb = {retention.max_gb:g} is less than one file of each arm",
            possible=f"{shard_gb:.3g} or more",
            hint="a smaller recording.shard_chunks makes smaller files",
        )
    _check_spec(config)
    rings, scene = needed_bytes(config)
    most = int(MEMORY_PART * memory_bytes())
    if rings + scene > most:
        raise ConfigError(
            f"geometry.stages = {config.geometry.stages}: the rings need {rings / 1e9:.3g} GB of memory and "
            f"the simulated scene {scene / 1e9:.3g} GB, {(rings + scene) / 1e9:.3g} GB in all",
            possible=f"up to {most / 1e9:.3g} GB on this host",
            hint="fewer geometry.stages, or a smaller stream.ring_seconds or ring_slots",
        )


def _check_spec(config: RigConfig) -> None:
    """Check the specification that `start` would create, except facts that only the devices have."""
    cameras = {
        arm: config.cameras.arm(arm).model_dump(include={"black_level_dn", "responsivity_dn"})
        | {"white_dn": config.cameras.arm(arm).white_dn}
        for arm in ARMS
    }
    try:
        RecordingSpec(
            run_id="check",
            stages=config.geometry.stages,
            substeps=config.geometry.substeps,
            pixels=config.pixels,
            dtype=config.cameras.a.dtype,
            first_line=0,
            clock=ClockFit(config.trigger.clock_hz, 0, 0),
            code=config.code.build().to_attrs(),
            substep_ticks=config.trigger.substep_ticks,
            trigger={},
            cameras=cameras,
            config=config.model_dump(mode="json"),
            codec=configured_codec(config, auto="none"),
            layout=config.cameras.layout,
            fibre=config.laid_out,
            **storage_settings(config),
        )
    except UsageError as error:
        raise ConfigError(
            f"[recording]: {error.message}", possible=error.possible, hint=error.hint
        ) from error


def needed_bytes(config: RigConfig) -> tuple[int, int]:
    """Return the memory needed for the rings, and for a simulated scene."""
    line_bytes = config.pixels * np.dtype(config.cameras.a.dtype).itemsize
    rings = len(ARMS) * config.ring_slots * config.stream.block_lines * line_bytes
    if not config.needs_scene:  # no camera is simulated from one
        return rings, 0
    scene = load_scene(config.scene_file())
    fibre = config.laid_out
    size = config.geometry.stages * config.geometry.substeps if fibre is None else fibre.side
    # Its scene is finer than its sensor's pixels.
    if scene.optics.layout == "interline":
        size *= scene.optics.baseline_factor
    return rings, SIMULATING * size * size * max(SCENE_BYTES, SCENE_BYTES // 4 * scene.sources)


def memory_bytes() -> int:
    """Return the memory of this host, or the limit of its control group."""
    # A container sees the host's memory in /proc, and is killed at its group's limit.
    host = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with contextlib.suppress(OSError, ValueError):  # no control group, or "max"
        return min(host, int(_CGROUP_LIMIT.read_text(encoding="ascii")))
    return host
