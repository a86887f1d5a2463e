"""Turns the arguments of ``acquire reconstruct`` into requests for videos."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.cli.durations import parse_duration_ns
from acquire.cli.moments import after_ns
from acquire.cli.progress import stage_progress
from acquire.cli.stretch import first_ns, lines_between
from acquire.config import check_plan, load_plan
from acquire.errors import UsageError
from acquire.recon.segments import Stretch, Voxels
from acquire.reconstruct.learned import PresetChoice, choose, recall
from acquire.reconstruct.select import (
    Selection,
    along_plan,
    by_lines,
    by_time,
    in_glimpses,
    in_tiles,
    in_voxels,
)
from acquire.store.delivery import check_new_file
from acquire.store.files import check_new_path

if TYPE_CHECKING:
    from acquire.config.plan import ReconstructionPlan
    from acquire.fibre import Tile
    from acquire.reconstruct import Options, VideoRequest
    from acquire.store import Recording

USUAL_VOXELS = "3x1"
PREVIEW_ITERATIONS = 8
PREVIEW_BANDWIDTH = 0.5
"""Share of the frames' Nyquist frequency; a search for the best one would take longer than the preview."""
PREVIEW_MERGE = 4
"""Sub-steps per frame."""
PREVIEW_LINES = 320
"""A longer range is previewed in glimpses, spread over the range."""
PREVIEW_SIDE = 16
"""Voxels along each side of a tile behind a fibre."""
GLIMPSES = 12
"""Number of glimpses, those of all tiles together."""
GLIMPSE_MERGE = 16
"""Sub-steps per frame of a glimpse."""
ENDS = {None: None, "trusted": False, "whole": True}


@dataclass(frozen=True, slots=True)
class Arguments:
    """The arguments of the command, as given. ``voxels`` is empty if no size was given."""

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
    out: str | None = None
    explain: bool = False
    try_orientations: bool = False
    workers: int | None = None
    dask: str | None = None

    @property
    def kinds(self) -> list[Voxels]:
        """The voxel sizes, each once."""
        return list(dict.fromkeys(map(parse_voxels, self.voxels or (USUAL_VOXELS,))))


@dataclass(frozen=True, slots=True)
class Prepared:
    """A request for each video, by the suffix of its name.

    ``plan`` is set if the range was divided by a plan; ``learned`` explains a preset that was chosen from
    past results.
    """

    requests: dict[str, VideoRequest]
    options: Options
    plan: ReconstructionPlan | None = None
    learned: str = ""


def prepare(recording: Recording, arguments: Arguments) -> Prepared:
    """Return the requests and the options to carry them out with. Raises UsageError and ConfigError."""
    prepared = _requests(recording, arguments)
    requests = {name: in_tiles(request, arguments.tiles) for name, request in prepared.requests.items()}
    prepared = replace(prepared, requests=requests)
    if arguments.preview:
        return prepared

    # With a time limit and no preset given, prefer the preset that `acquire tradeoff` found best.
    options = prepared.options
    known = [each for each in recall() if each.solver == options.solver]
    if arguments.preset:
        choice = PresetChoice(arguments.preset, "")
    elif options.budget_s is None or not known:
        choice = PresetChoice(None, "")
    else:
        grids = [request.grid for request in requests.values()]
        # The whole work has to fit the limit: all videos, and all tiles of each.
        tiles = max(1, *(len(request.tiles) for request in requests.values()))
        voxels = tiles * sum(grid.frames * grid.side**2 for grid in grids)
        sizes = {(grid.voxels.spatial_merge, grid.voxels.temporal_merge) for grid in grids}
        choice = choose(known, options.budget_s, voxels, sizes.pop() if len(sizes) == 1 else None)
    options = replace(options, preset=choice.preset or options.preset)  # type: ignore[arg-type]  # checked when it is used
    return replace(prepared, options=options, learned=choice.why)


def check_arguments(arguments: Arguments) -> None:
    """Raise UsageError for arguments that contradict each other, and for a plan file that exists."""
    if arguments.ends not in ENDS:
        raise UsageError(f"there is no --ends {arguments.ends}", possible="trusted, whole")
    if arguments.try_orientations and arguments.tiles:
        raise UsageError(
            "--try-orientations cannot be used behind a fibre: if an arm is mirrored, a tile is seen by "
            "other columns",
            possible="`acquire diagnose --tile`, which checks the orientation; [fibre] in the rig file, "
            "which places the fibre bands",
        )
    ways = {
        "--plan": arguments.plan is not None,
        "--segment": bool(arguments.segments),
        "--auto": arguments.auto,
        "--preview": arguments.preview,
    }
    chosen = [name for name, given in ways.items() if given]
    if len(chosen) > 1:
        raise UsageError(f"{', '.join(ways)} exclude each other", possible="one of them")
    # An explanation uses voxel sizes even beside a plan.
    if chosen and arguments.voxels and not arguments.explain:
        raise UsageError(
            f"--voxels, --nm and --tm have no effect with {chosen[0]}, which has voxels of its own",
            possible=f"{chosen[0]}, or voxel sizes",
        )
    if arguments.preview and (arguments.preset, arguments.options.iterations) != (None, None):
        raise UsageError(
            f"--preset and --iterations have no effect with --preview, which makes {PREVIEW_ITERATIONS} "
            "iterations",
            possible="a part of the lines with coarse voxels: --from, --to and --voxels 6x4 --preset fast",
        )
    # A preview has no plan, only coarse voxels.
    planned = bool(chosen) and not arguments.preview
    if arguments.save_plan is not None:
        if not planned:
            raise UsageError(
                "--save-plan: there is no plan to save", possible="with --auto, --plan or --segment"
            )
        check_new_file(arguments.save_plan)
        if arguments.out is not None and arguments.save_plan.resolve() == Path(arguments.out).resolve():
            raise UsageError(
                f"--save-plan and --out are both {arguments.save_plan}, but a plan is a file and a video a "
                "directory",
                possible="two names: --save-plan NAME.toml --out NAME.zarr",
            )


def suffixes(arguments: Arguments) -> list[str]:
    """Return what distinguishes the name of each video: its voxel size, or nothing if there is one video."""
    single = arguments.plan is not None or arguments.segments or arguments.auto or arguments.preview
    kinds = arguments.kinds
    return [""] if single or len(kinds) == 1 else [str(kind) for kind in kinds]


def _requests(recording: Recording, arguments: Arguments) -> Prepared:
    selection, whole = _select(recording, arguments), ENDS[arguments.ends]
    if arguments.preview:
        options = replace(
            arguments.options,
            iterations=PREVIEW_ITERATIONS,
            bandwidth=PREVIEW_BANDWIDTH,
            # Voxels so large never explain the lines, so that there is nothing to find out.
            check=False,
            error=False,
        )
        return Prepared({"": _preview(selection, len(arguments.tiles), whole=whole)}, options)
    plan = _plan(recording, selection, arguments)
    if plan is not None:
        if arguments.save_plan is not None:
            _write_plan(arguments.save_plan, plan)
        return Prepared({"": along_plan(selection, plan)}, arguments.options, plan)
    requests = [in_voxels(selection, kind, whole_ends=whole) for kind in arguments.kinds]
    return Prepared(dict(zip(suffixes(arguments), requests, strict=True)), arguments.options)


def parse_voxels(text: str) -> Voxels:
    """Parse a voxel size: ``3x4`` is N_m = 3, T_m = 4."""
    found = re.fullmatch(r"(\d{1,18})[x×](\d{1,18})", text)
    if found is None:
        raise UsageError(f"the voxel size {text!r} cannot be read", possible="NMxTM, such as 3x1 or 1x820")
    return Voxels(int(found[1]), int(found[2]))


def parse_segment(text: str) -> dict[str, float]:
    """Parse a sub-segment to a table of a plan file: by lines, ``712:3x4``, by time, ``1.1ms:1x230``, or the
    rest, ``:3x4``."""
    length, colon, kind = text.rpartition(":")
    if not colon:
        raise UsageError(
            f"the sub-segment {text!r} cannot be read: it has no ':' before its voxel size",
            possible="LENGTH:NMxTM, such as 712:3x4 (lines), 1.1ms:1x230, or :3x4 for the rest",
        )
    voxels = parse_voxels(kind)
    table: dict[str, float] = {
        "spatial_merge": voxels.spatial_merge,
        "temporal_merge": voxels.temporal_merge,
    }
    if re.fullmatch(r"\d{1,18}", length):  # not isdigit: to Python, ² is a digit and no number
        table["lines"] = int(length)
    elif length:
        table["seconds"] = parse_duration_ns(length) * 1e-9
    return table


def requested_lines(recording: Recording, arguments: Arguments) -> tuple[int | None, int | None]:
    """Return the first line and the number of lines that show the requested range; None without a limit.

    Raises UsageError for times that the lines do not show.
    """
    first, count, begin, end = arguments.first_line, arguments.lines, arguments.begin, arguments.end
    if first is not None or count is not None:
        return lines_between(recording, first, count, begin, end)
    if begin is None and end is None:
        return None, None
    selection = _select(recording, arguments)
    shown = Stretch(*selection.extent(Voxels(1, 1), Voxels(1, 1), whole=False), Voxels(1, 1))
    needed = selection.stream.sub_segment(shown)
    return needed.first_line, None if end is None else needed.lines


def _select(recording: Recording, arguments: Arguments) -> Selection:
    first, count, begin, end = arguments.first_line, arguments.lines, arguments.begin, arguments.end
    if begin is None and end is None:
        return by_lines(recording, first, count)
    if first is not None or count is not None:
        return by_lines(recording, *lines_between(recording, first, count, begin, end))
    # two times select the frames between them, which is not the same as selecting the lines
    begin_ns, end_ns = (
        after_ns(
            text,
            lambda: first_ns(recording),
            lambda line: round((line - recording.first_line) * recording.line_period_ns),
        )
        for text in (begin, end)
    )
    return by_time(recording, begin_ns, end_ns)


def _preview(selection: Selection, tiles: int, *, whole: bool | None) -> VideoRequest:
    """Request a preview that takes a second or two, however long the range: coarse, or glimpses of it."""
    stream = selection.stream
    size = stream.geometry(1).size
    side = min(2 * stream.substeps, size)
    if tiles:  # shown coarser: `PREVIEW_SIDE` voxels or more along each side of a tile
        side = max(merge for merge in range(1, max(1, size // PREVIEW_SIDE) + 1) if not size % merge)
    begin, end = selection.extent(Voxels(1, 1), Voxels(1, 1), whole=False)
    lines = stream.sub_segment(Stretch(begin, end, Voxels(1, 1))).lines
    glimpses = max(1, GLIMPSES // max(1, tiles))
    if lines > PREVIEW_LINES and end - begin >= glimpses * GLIMPSE_MERGE:
        return in_glimpses(selection, Voxels(side, GLIMPSE_MERGE), glimpses)
    # In one piece, however long: its voxels are too coarse to need sub-segments.
    return in_voxels(selection, Voxels(side, PREVIEW_MERGE), whole_ends=whole, longest=1 << 62)


def _plan(recording: Recording, selection: Selection, arguments: Arguments) -> ReconstructionPlan | None:
    if arguments.auto:
        from acquire.reconstruct.propose import propose

        with stage_progress("looking for changes in the scene", "--from and --to, for a part") as advance:
            return propose(
                recording,
                selection,
                whole=arguments.ends == "whole",
                progress=advance,
                calibration=arguments.options.calibration,
                tiles=arguments.tiles,
            )
    if arguments.plan is not None:
        plan = load_plan(arguments.plan)
        # --ends overrides what the file says.
        return plan if arguments.ends is None else plan.model_copy(update={"ends": arguments.ends})
    if not arguments.segments:
        return None
    ends = {} if arguments.ends is None else {"ends": arguments.ends}
    return check_plan({"segments": [parse_segment(text) for text in arguments.segments], **ends}, "--segment")


def _write_plan(path: Path, plan: ReconstructionPlan) -> None:
    """Write a plan as TOML, in which strings and numbers look the same as in JSON."""
    from acquire.store.delivery import whole_file
    from acquire.store.refusals import refused

    # Checked before the plan was made, which takes time: it may exist by now.
    check_new_path(path)
    text = [f"{key} = {json.dumps(value)}" for key, value in plan.model_dump(exclude={"segments"}).items()]
    for part in plan.segments:
        text += ["", "[[segments]]"]
        text += [f"{key} = {json.dumps(value)}" for key, value in part.model_dump(exclude_none=True).items()]
    with whole_file(path) as file, refused(path, "written"):
        file.write_text("\n".join(text) + "\n", encoding="utf-8")
