"""What ``acquire reconstruct`` was asked for, in words, as requests that can be carried out."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from acquire.cli.durations import parse_duration_ns
from acquire.cli.moments import after_ns
from acquire.cli.progress import stage_progress
from acquire.cli.stretch import first_ns, lines_between
from acquire.config import check_plan, load_plan
from acquire.cores import idle_cores, limit_blas
from acquire.errors import UsageError
from acquire.recon.segments import Stretch, Voxels
from acquire.reconstruct.learned import Choice, choose, recall
from acquire.reconstruct.select import (
    Selection,
    along_plan,
    by_lines,
    by_time,
    in_glimpses,
    in_tiles,
    in_voxels,
)
from acquire.store.files import check_new_path

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.config.plan import ReconstructionPlan
    from acquire.fibre import Tile
    from acquire.reconstruct import Options, VideoRequest
    from acquire.store import Recording

PREVIEW_ITERATIONS = 8
PREVIEW_BANDWIDTH = 0.5
"""Of its frames' Nyquist frequency: to find out would take longer than the preview."""
PREVIEW_MERGE = 4
PREVIEW_LINES = 320
"""More than these are not looked at one after the other, but in glimpses."""
PREVIEW_SIDE = 16
"""Voxels of a tile of a scene behind a fibre, along either side."""
GLIMPSES = 12
GLIMPSE_MERGE = 16
ENDS = {None: None, "trusted": False, "whole": True}


@dataclass(frozen=True, slots=True)
class Asked:
    """The options of the command, as given."""

    first_line: int | None
    lines: int | None
    begin: str | None
    end: str | None
    voxels: tuple[str, ...]
    plan: str | None
    segments: tuple[str, ...]
    auto: bool
    save_plan: Path | None
    ends: str | None
    preview: bool
    preset: str | None
    options: Options
    tiles: tuple[Tile, ...] = ()


@dataclass(frozen=True, slots=True)
class Prepared:
    """A request for each video, by what is added to its name; the plan where there is one; ``learned`` says
    why the preset was preferred.
    """

    requests: dict[str, VideoRequest]
    options: Options
    plan: ReconstructionPlan | None = None
    learned: str = ""


def prepare(recording: Recording, asked: Asked) -> Prepared:
    """What is to be done. UsageError and ConfigError for what cannot be."""
    prepared = _requests(recording, asked)
    requests = {name: in_tiles(request, asked.tiles) for name, request in prepared.requests.items()}
    prepared = replace(prepared, requests=requests)
    if asked.preview:
        return prepared
    learned = Choice(asked.preset, "") if asked.preset else _learned(prepared)
    options = replace(prepared.options, preset=learned.preset or prepared.options.preset)  # type: ignore[arg-type]  # checked where it is used
    return replace(prepared, options=options, learned=learned.why)


def _learned(prepared: Prepared) -> Choice:
    """The preset that gets furthest in the budget, as `acquire tradeoff` found out, or why there is none."""
    options = prepared.options
    known = [each for each in recall() if each.solver == options.solver]
    if options.budget_s is None or not known:
        return Choice(None, "")
    grids = [request.grid for request in prepared.requests.values()]
    tiles = max(1, *(len(request.tiles) for request in prepared.requests.values()))
    return choose(known, options.budget_s, tiles * sum(grid.frames * grid.side**2 for grid in grids))


def _requests(recording: Recording, asked: Asked) -> Prepared:
    if asked.ends not in ENDS:
        raise UsageError(f"--ends {asked.ends} is not known", possible="trusted, whole")
    if (asked.plan is not None) + bool(asked.segments) + asked.auto + asked.preview > 1:
        raise UsageError("--plan, --segment, --auto and --preview exclude each other", possible="one of them")
    selection, whole = _select(recording, asked), ENDS[asked.ends]
    if asked.preview:
        options = replace(
            asked.options,
            iterations=PREVIEW_ITERATIONS,
            bandwidth=PREVIEW_BANDWIDTH,
            check=False,
            error=False,
        )
        return Prepared({"": _preview(selection, len(asked.tiles), whole=whole)}, options)
    plan = _plan(recording, selection, asked)
    if plan is not None:
        if asked.save_plan is not None:
            _write_plan(asked.save_plan, plan)
        return Prepared({"": along_plan(selection, plan)}, asked.options, plan)
    kinds = [parse_voxels(text) for text in asked.voxels]
    requests = [in_voxels(selection, kind, whole_ends=whole) for kind in kinds]
    names = [str(kind) if len(kinds) > 1 else "" for kind in kinds]
    return Prepared(dict(zip(names, requests, strict=True)), asked.options)


def parse_voxels(text: str) -> Voxels:
    """``3x4`` is N_m = 3, T_m = 4."""
    found = re.fullmatch(r"(\d+)[x×](\d+)", text)
    if found is None:
        raise UsageError(f"voxels {text!r} cannot be read", possible="NMxTM, as 3x1 or 1x820")
    return Voxels(int(found[1]), int(found[2]))


def parse_segment(text: str) -> dict[str, float]:
    """``712:3x4`` are lines, ``1.1ms:1x230`` a time, ``:3x4`` the rest; as a plan file's table."""
    length, _, kind = text.rpartition(":")
    voxels = parse_voxels(kind)
    table: dict[str, float] = {
        "spatial_merge": voxels.spatial_merge,
        "temporal_merge": voxels.temporal_merge,
    }
    if length.isdigit():
        table["lines"] = int(length)
    elif length:
        table["seconds"] = parse_duration_ns(length) * 1e-9
    return table


def _select(recording: Recording, asked: Asked) -> Selection:
    timed = asked.begin is not None or asked.end is not None
    if not timed:
        return by_lines(recording, asked.first_line, asked.lines)
    if asked.first_line is not None or asked.lines is not None:
        return by_lines(
            recording, *lines_between(recording, asked.first_line, asked.lines, asked.begin, asked.end)
        )
    return by_time(recording, _after_ns(recording, asked.begin), _after_ns(recording, asked.end))


def _after_ns(recording: Recording, text: str | None) -> int | None:
    """A time as nanoseconds after the read-out of the recording's first line begins."""
    return after_ns(
        text,
        lambda: first_ns(recording),
        lambda line: round((line - recording.first_line) * recording.line_period_ns),
    )


def _preview(selection: Selection, tiles: int, *, whole: bool | None) -> VideoRequest:
    """The whole of a selection in a second or two, however long it is: coarse, or glimpses of it."""
    stream = selection.stream
    size = stream.geometry(1).size
    side = min(2 * stream.substeps, size)
    if tiles:  # a scene of so many is seen from farther away, in voxels that fill each
        side = max(merge for merge in range(1, max(1, size // PREVIEW_SIDE) + 1) if not size % merge)
    begin, end = selection.extent(Voxels(1, 1), Voxels(1, 1), whole=False)
    lines = stream.sub_segment(Stretch(begin, end, Voxels(1, 1))).lines
    glimpses = max(1, GLIMPSES // max(1, tiles))
    if lines > PREVIEW_LINES and end - begin >= glimpses * GLIMPSE_MERGE:
        return in_glimpses(selection, Voxels(side, GLIMPSE_MERGE), glimpses)
    return in_voxels(selection, Voxels(side, PREVIEW_MERGE), whole_ends=whole, longest=1 << 62)


def _plan(recording: Recording, selection: Selection, asked: Asked) -> ReconstructionPlan | None:
    if asked.auto:
        from acquire.reconstruct.propose import propose

        # threads of BLAS that wait for a core that others use cost five times the time
        with (
            stage_progress("looking for what changes", "--from and --to, for a part") as advance,
            limit_blas(idle_cores()),
        ):
            return propose(
                recording,
                selection,
                whole=asked.ends == "whole",
                progress=advance,
                calibration=asked.options.calibration,
                tiles=asked.tiles,
            )
    if asked.plan is not None:
        return load_plan(asked.plan)
    if not asked.segments:
        return None
    ends = {} if asked.ends is None else {"ends": asked.ends}
    return check_plan({"segments": [parse_segment(text) for text in asked.segments], **ends}, "--segment")


def _write_plan(path: Path, plan: ReconstructionPlan) -> None:
    """As TOML, whose strings and numbers are JSON's."""
    check_new_path(path)
    text = [f"{key} = {json.dumps(value)}" for key, value in plan.model_dump(exclude={"segments"}).items()]
    for part in plan.segments:
        text += ["", "[[segments]]"]
        text += [f"{key} = {json.dumps(value)}" for key, value in part.model_dump(exclude_none=True).items()]
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
