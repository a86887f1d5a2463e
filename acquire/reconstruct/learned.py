"""What trade-offs found out on this machine, kept for `--budget`: which preset gets furthest in a time.

Of one scene a preset says little: what is best for lamps that blink loses where things move. So a preset is
preferred only by what several scenes say, the same for each preset; runs that a budget cut say nothing.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

VERSION = 2
FEWEST_SCENES = 3
"""With fewer in common, presets are not ranked."""


@dataclass(frozen=True, slots=True)
class Learned:
    """A solver's preset reached ``psnr_db`` in ``seconds`` for so many voxels of a scene and its noise."""

    solver: str
    preset: str
    spatial_merge: int
    temporal_merge: int
    voxels: int
    scene: str
    seconds: float
    psnr_db: float


@dataclass(frozen=True, slots=True)
class Choice:
    """The preset that is preferred, or None; ``why`` says by what, or why none is."""

    preset: str | None
    why: str


def learned_path() -> Path:
    """``$XDG_CACHE_HOME/acquire/tradeoff.json``, or under ``~/.cache``."""
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(cache) / "acquire" / "tradeoff.json"


def remember(found: Iterable[Learned], path: Path | None = None) -> Path:
    """Add to what is known; what was learned of the same case before is replaced."""
    place = path or learned_path()
    known = {_case(each): each for each in [*recall(place), *found]}
    place.parent.mkdir(parents=True, exist_ok=True)
    part = place.with_name(f".{place.name}.{os.getpid()}")
    document = {"version": VERSION, "learned": [asdict(each) for each in known.values()]}
    part.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    part.replace(place)
    return place


def recall(path: Path | None = None) -> list[Learned]:
    """What is known; nothing where the file is absent, or not ours."""
    try:
        document = json.loads((path or learned_path()).read_text(encoding="utf-8"))
        return [Learned(**each) for each in document["learned"]] if document["version"] == VERSION else []
    except (OSError, ValueError, TypeError, KeyError):
        return []


def choose(known: Sequence[Learned], budget_s: float, voxels: int, workers: int = 1) -> Choice:
    """The best on average that ends within ``budget_s`` for ``voxels`` voxels, of one solver's presets.

    Times are scaled from the nearest size; presets are compared on the scenes that all of them were tried on.
    """
    if not known:
        return Choice(None, "nothing was learned yet: acquire tradeoff, with several scenes")
    nearest = min(known, key=lambda each: abs(each.voxels - voxels)).voxels
    by_preset: dict[str, dict[str, Learned]] = defaultdict(dict)
    for each in known:
        if each.voxels == nearest:
            by_preset[each.preset][each.scene] = each
    scenes = sorted(set.intersection(*(set(each) for each in by_preset.values())))
    if len(scenes) < FEWEST_SCENES:
        seen = (
            f"{len(scenes)} scene{'' if len(scenes) == 1 else 's'} ({', '.join(scenes) or 'none in common'})"
        )
        return Choice(
            None, f"what was learned is of {seen}, and {FEWEST_SCENES} are needed to prefer a preset"
        )
    scale = voxels / nearest / max(1, workers)
    in_time = {
        preset: fmean(tried[scene].psnr_db for scene in scenes)
        for preset, tried in by_preset.items()
        if max(tried[scene].seconds for scene in scenes) * scale <= budget_s
    }
    if not in_time:
        return Choice(None, f"no preset ended in that time on {len(scenes)} scenes")
    return Choice(
        max(in_time, key=in_time.__getitem__), f"learned from {len(scenes)} scenes: {', '.join(scenes)}"
    )


def _case(each: Learned) -> tuple[str, str, int, int, int, str]:
    return (
        each.solver,
        each.preset,
        each.spatial_merge,
        each.temporal_merge,
        each.voxels,
        each.scene,
    )
