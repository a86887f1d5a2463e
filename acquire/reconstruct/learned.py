"""What a trade-off found out on this machine, kept for `--budget`: which preset gets furthest in a time."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

VERSION = 1


@dataclass(frozen=True, slots=True)
class Learned:
    """A preset of a solver reached ``psnr_db`` in ``seconds`` for so many voxels."""

    solver: str
    preset: str
    spatial_merge: int
    temporal_merge: int
    voxels: int
    seconds: float
    psnr_db: float


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


def choose(known: Sequence[Learned], budget_s: float, voxels: int, workers: int = 1) -> Learned | None:
    """The best that ends within ``budget_s`` for ``voxels`` voxels, times scaled from the nearest size.

    None when nothing is known, or when nothing known is fast enough.
    """
    if not known:
        return None
    nearest = min(known, key=lambda each: abs(each.voxels - voxels)).voxels
    of_size = [each for each in known if each.voxels == nearest]
    scale = voxels / nearest / max(1, workers)
    in_time = [each for each in of_size if each.seconds * scale <= budget_s]
    return max(in_time, key=lambda each: each.psnr_db, default=None)


def _case(each: Learned) -> tuple[str, str, int, int, int]:
    return (each.solver, each.preset, each.spatial_merge, each.temporal_merge, each.voxels)
