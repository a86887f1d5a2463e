"""Results of trade-offs on this machine, kept for `--budget`: which preset reaches most in a given time.

One scene says little about a preset: the best for blinking lamps is worse for moving objects. A preset is
therefore preferred only on the evidence of several scenes, the same for each preset. Runs that a budget cut
short do not count.
"""

from __future__ import annotations

import json
import os
import secrets
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from pydantic import TypeAdapter

from acquire.place import home
from acquire.store.files import Publisher

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

VERSION = 2
"""Version of the file; one of another version counts as empty."""
FEWEST_SCENES = 3
"""Fewest common scenes with which presets are ranked."""


@dataclass(frozen=True, slots=True)
class Learned:
    """A solver's preset reached ``psnr_db`` in ``seconds`` for ``voxels`` of a scene with its noise."""

    solver: str
    preset: str
    spatial_merge: int
    temporal_merge: int
    voxels: int
    scene: str
    seconds: float
    psnr_db: float


@dataclass(frozen=True, slots=True)
class PresetChoice:
    """The preferred preset, or None; ``why`` states the evidence, or why there is none."""

    preset: str | None
    why: str


def learned_path() -> Path:
    """Return ``$XDG_CACHE_HOME/acquire/tradeoff.json``, or the same under ``~/.cache``."""
    cache = os.environ.get("XDG_CACHE_HOME") or str(home() / ".cache")
    return Path(cache) / "acquire" / "tradeoff.json"


def remember(found: Iterable[Learned], path: Path | None = None) -> Path:
    """Add results to the file; they replace earlier ones of the same case.

    Raises OSError if the disk refuses, or the earlier ones cannot be read; the file is then as it was.
    """
    path = path or learned_path()
    known = {
        (each.solver, each.preset, each.spatial_merge, each.temporal_merge, each.voxels, each.scene): each
        for each in [*_read(path), *found]
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    document = {"version": VERSION, "learned": [asdict(each) for each in known.values()]}
    # It is renamed when complete: a program that reads meanwhile, or after a power cut, finds the old file or
    # the new one.
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    Publisher(part).replace(path, (json.dumps(document, indent=1) + "\n").encode(), durable=True)
    return path


def recall(path: Path | None = None) -> list[Learned]:
    """Return the results in the file; none if it is absent, cannot be read, is damaged or not ours."""
    try:
        return _read(path or learned_path())
    except OSError:
        return []


def _read(path: Path) -> list[Learned]:
    """Return the results in the file; none if it is absent, damaged or not ours. Raises OSError."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        known = document["learned"] if document["version"] == VERSION else []
        return TypeAdapter(list[Learned]).validate_python(known)
    except (FileNotFoundError, ValueError, TypeError, KeyError):
        return []


def choose(
    known: Sequence[Learned], budget_s: float, voxels: int, merges: tuple[int, int] | None = None
) -> PresetChoice:
    """Choose the best preset on average, among those that end within ``budget_s`` for ``voxels`` voxels.

    ``known`` is of one solver. Times are scaled from those of the nearest number of voxels; if voxels of
    different sizes (N_m, T_m) were as many, from those of the size ``merges`` or, without results of that
    size, of the one tried on most scenes. Presets are compared on the scenes that all of them were tried on.
    """
    if not known:
        return PresetChoice(None, "no preset was tried yet: run acquire tradeoff with several scenes")
    nearest = min(known, key=lambda each: abs(each.voxels - voxels)).voxels
    by_merges: dict[tuple[int, int], dict[str, dict[str, Learned]]] = defaultdict(lambda: defaultdict(dict))
    for each in known:
        if each.voxels == nearest:
            tried_in = by_merges[each.spatial_merge, each.temporal_merge]
            tried_in[each.preset][each.scene] = each
    scenes_of = {
        sizes: sorted(set.intersection(*(set(each) for each in presets.values())))
        for sizes, presets in by_merges.items()
    }
    # Never a mixture: the same scene is easier in some voxels than in others, and takes another time.
    sizes = max(scenes_of, key=lambda each: (each == merges, len(scenes_of[each])))
    by_preset, scenes = by_merges[sizes], scenes_of[sizes]
    if len(scenes) < FEWEST_SCENES:
        tried = f"{len(scenes)} scene{'' if len(scenes) == 1 else 's'}"
        names = ", ".join(scenes) or "none in common"
        return PresetChoice(
            None, f"presets were tried on {tried} ({names}), and {FEWEST_SCENES} are needed to prefer one"
        )
    # Time grows with the voxels; parts that are solved side by side end sooner, but the limit must hold on
    # cores that others use, too.
    scale = voxels / nearest
    in_time = {
        preset: fmean(tried[scene].psnr_db for scene in scenes)
        for preset, tried in by_preset.items()
        # The slowest scene has to end in time.
        if max(tried[scene].seconds for scene in scenes) * scale <= budget_s
    }
    if not in_time:
        return PresetChoice(None, f"no preset ended in that time on {len(scenes)} scenes")
    return PresetChoice(
        max(in_time, key=in_time.__getitem__), f"learned from {len(scenes)} scenes: {', '.join(scenes)}"
    )
