"""``acquire import``: make a recording from lines that other software captured."""

from __future__ import annotations

import math
import re
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.completion import rigs
from acquire.cli.moments import utc_ns
from acquire.cli.output import JsonFlag, print_json, print_warning, say
from acquire.cli.progress import stage_progress
from acquire.errors import UsageError
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.codes import Code
    from acquire.exchange import Arm, Instrument

DTYPES = {"uint8": "u1", "u8": "u1", "uint16": "<u2", "u16": "<u2", "<u2": "<u2", ">u2": ">u2"}
"""Names for the type of raw binary data → NumPy's name; ``>u2`` is big-endian."""
LATEST_NS = 4_102_444_800 * 10**9
"""The beginning of 2100. Times are 64-bit numbers of ns, which end in 2262."""


def register(app: typer.Typer) -> None:
    app.command("import", rich_help_panel="Recordings")(import_lines)


def import_lines(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE",
            help="One file for each arm (a, then b), or one file with both: .npy, .h5, .tif or .raw.",
        ),
    ],
    out: Annotated[str, typer.Option(metavar="RECORDING", help="New recording: NAME.zarr, or a URL.")],
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file with the geometry, code, trigger and cameras. The other options override it.",
        ),
    ] = None,
    stages: Annotated[
        int | None,
        typer.Option(help="M, number of stages of the sensor, which is the number of pixels per line."),
    ] = None,
    substeps: Annotated[int | None, typer.Option(help="S, number of sub-steps per line.")] = None,
    line_rate: Annotated[float | None, typer.Option(metavar="HZ", help="Number of lines per second.")] = None,
    code: Annotated[
        str | None,
        typer.Option(
            metavar="CODE",
            help="Exposure code: prbs:DEGREE:SEED, prbs:DEGREE:0xSTATE, bits:0x…, bits:FILE or constant:1.",
        ),
    ] = None,
    code_start: Annotated[
        int, typer.Option(min=0, help="Index of the code bit in the first sub-step of line 0.")
    ] = 0,
    code_repeats: Annotated[
        bool,
        typer.Option("--code-repeats", help="Repeat the bits of a bits: code after the last one."),
    ] = False,
    first_line: Annotated[int, typer.Option(min=0, help="Number of the first line in the files.")] = 0,
    lines: Annotated[
        int | None, typer.Option(help="Number of lines of each arm. Default: all lines.")
    ] = None,
    arm: Annotated[
        str | None,
        typer.Option(metavar="a|b", help="Arm whose lines a single file holds: a or b. Default: a."),
    ] = None,
    dtype: Annotated[
        str | None,
        typer.Option(
            metavar="TYPE", help="Sample type of raw binary files: uint8, uint16, or >u2 (big-endian)."
        ),
    ] = None,
    pixels: Annotated[
        int | None, typer.Option(min=1, help="Number of pixels per line in raw binary files.")
    ] = None,
    skip_bytes: Annotated[
        int, typer.Option(min=0, help="Number of bytes before the first line in raw binary files.")
    ] = 0,
    dataset: Annotated[
        str | None,
        typer.Option(
            metavar="PATH",
            help="Path of the lines inside HDF5 files, such as /entry/data/lines. Default: the only such "
            "array.",
        ),
    ] = None,
    columns_a: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST:END", help="Range of pixels in each line that belongs to arm a. Default: all."
        ),
    ] = None,
    columns_b: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST:END",
            help="Range of pixels in each line that belongs to arm b, possibly in the same file. Default: "
            "all.",
        ),
    ] = None,
    white: Annotated[
        float | None,
        typer.Option(
            metavar="DN",
            help="Value at which a pixel is saturated. Default: the rig's, or the sample type's largest.",
        ),
    ] = None,
    black: Annotated[
        float | None,
        typer.Option(metavar="DN", help="Value of a pixel without light. Default: the rig's, or 0."),
    ] = None,
    responsivity: Annotated[
        float | None,
        typer.Option(
            metavar="DN",
            help="Responsivity in DN per unit of light and sub-step. Default: the rig's, or 1.",
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            metavar="UTC",
            help="UTC at which the first line was read out, such as 2026-01-31T12:00:00.25. Default: the "
            "beginning of 1970.",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Make a recording from lines that other software captured, to verify, cut and reconstruct it.

    Only the options that you give relate these lines to the exposure code, so the recording states what is
    not known about the lines.

    Example: [bold]acquire import a.tif b.tif --out run.zarr --config rig.toml[/]
    """
    from acquire.exchange import Layout, import_lines
    from acquire.store.delivery import check_new_place

    # What can be refused by the arguments alone is refused before the files are opened, which may be large.
    if len(files) > 2:
        raise UsageError(
            f"{len(files)} files of lines were given", possible="one for each arm, or one with both"
        )
    check_new_place(out)
    options = {"white_dn": white, "black_level_dn": black, "responsivity_dn": responsivity}
    instrument = _instrument(config, stages, substeps, line_rate, code, repeats=code_repeats)
    start_ns = None if start is None else utc_ns(start)
    if start is not None and start_ns is None:
        raise UsageError(f"--start {start!r} is not a time", possible="UTC such as 2026-01-31T12:00:00.25")
    if start_ns is not None and not 0 <= start_ns < LATEST_NS:
        raise UsageError(f"--start {start} is out of range", possible="the years 1970 to 2099")
    instrument = replace(
        instrument,
        cameras={each: _levels(instrument.cameras.get(each, {}), options) for each in ("a", "b")},
        code_start=code_start,
        first_line=first_line,
        start_ns=start_ns,
    )
    if dtype is not None and dtype not in DTYPES:
        raise UsageError(f"there is no --dtype {dtype!r}", possible=", ".join(DTYPES))
    layout = Layout(None if dtype is None else DTYPES[dtype], pixels, skip_bytes, dataset)
    columns = {"a": _columns(columns_a), "b": _columns(columns_b)}
    with ExitStack() as held:
        arms = _arms(held, files, layout, columns, arm)
        # The characters of a rig's name, after which other runs are named.
        run_id = re.sub(r"[^A-Za-z0-9._-]", "_", PurePosixPath(out).stem) or "imported"
        with stage_progress(f"importing {PurePosixPath(out).name}") as advance:
            done = import_lines(arms, instrument, out, run_id, advance, most_lines=lines)
    if json:
        facts = {"path": str(done.path), "lines": done.lines, "arms": done.arms, "unknown": done.unknown}
        print_json(facts)
        return
    whose = f"arm{'s' * (len(done.arms) - 1)} {' and '.join(done.arms)}"
    say(f"{done.path}: {counted(done.lines, 'line')} of {whose}")
    for text in done.unknown:
        print_warning(f"not known: {text}")
    say(f"  to check the lines against the code: acquire diagnose {done.path}")


def _levels(known: Mapping[str, float], options: Mapping[str, float | None]) -> dict[str, float]:
    """Return the levels of a camera: those known from the rig file, and the given ones instead."""
    from acquire.config.base import MOST_DN

    least_dn = {"white_dn": 1e-9, "black_level_dn": 0.0, "responsivity_dn": 1e-9}
    for key, value in options.items():
        if value is not None and not least_dn[key] <= value <= MOST_DN:
            name = f"--{key.partition('_')[0]}"
            above = "0" if key == "black_level_dn" else "more than 0"
            raise UsageError(f"{name} {value:g} is out of range", possible=f"{above}, up to {MOST_DN:g}")
    levels = {**known, **{key: value for key, value in options.items() if value is not None}}
    black, white = levels.get("black_level_dn", 0.0), levels.get("white_dn", math.inf)
    if black >= white:
        raise UsageError(
            f"the black level, {black:g} DN, is not below white, {white:g} DN", hint="--black and --white"
        )
    return levels


def _columns(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,9}):(\d{1,9})", text)
    if found is None:
        raise UsageError(f"columns {text!r} cannot be read", possible="FIRST:END, such as 0:192")
    return int(found[1]), int(found[2])


def _arms(
    held: ExitStack,
    files: list[Path],
    layout: Any,
    columns: dict[str, tuple[int, int] | None],
    single: str | None,
) -> dict[str, Arm]:
    """Find the lines of each arm: a file of its own, a range of columns, or one of the arms in a file.

    ``single`` is the arm of a file that holds only one.
    """
    from acquire.exchange import Arm, open_lines

    arm = single or "a"
    if arm not in columns:
        raise UsageError(f"there is no arm {arm!r}", possible="a, b")
    if single is not None and (len(files) == 2 or all(columns.values())):
        raise UsageError(f"--arm {arm}: both arms were given", possible="--arm with a file of one arm")
    if len(files) == 2 or all(columns.values()):
        # With a range of columns for each arm, both may come from one file, which is then opened twice.
        paths = {"a": files[0], "b": files[-1]}
        opened = {
            name: held.enter_context(open_lines(path, replace(layout, columns=columns[name])))
            for name, path in paths.items()
        }
        for file in opened.values():
            if file.arms == 2:
                raise UsageError(
                    f"{file.path} has two arms, but there is a file for each arm", possible="one arm per file"
                )
        return {name: Arm(file) for name, file in opened.items()}
    other = "b" if arm == "a" else "a"
    if columns[other] is not None:
        raise UsageError(
            f"--columns-{other} selects pixels of arm {other}, but {files[0]} is read as arm {arm}",
            possible=f"--columns-{arm} as well, for a file with both arms side by side, or --arm {other}",
        )
    file = held.enter_context(open_lines(files[0], replace(layout, columns=columns[arm])))
    if single is not None and file.arms == 2:
        raise UsageError(f"--arm {arm}: {file.path} has two arms", possible="--arm with a file of one arm")
    # A file of both arms has them in this order, as our own exports do.
    return {arm: Arm(file)} if file.arms == 1 else {"a": Arm(file, 0), "b": Arm(file, 1)}


def _instrument(
    config: str | None,
    stages: int | None,
    substeps: int | None,
    line_rate: float | None,
    code: str | None,
    *,
    repeats: bool,
) -> Instrument:
    """Build the instrument from the rig file and the options, which override the file."""
    from acquire.exchange import clock_of, parse_code

    light = None if code is None else parse_code(code, repeats=repeats)
    if config is None:
        found = _of_options(stages, substeps, line_rate, light)
    else:
        known = _of_rig(config)
        if known.fibre is not None and (stages, substeps) != (None, None):
            raise UsageError(
                "--stages and --substeps cannot change a rig with [fibre], whose fibre bands have M·S rows",
                possible="a rig file with matching geometry and fibre",
            )
        found = replace(
            known,
            stages=known.stages if stages is None else stages,
            substeps=known.substeps if substeps is None else substeps,
            code=light or known.code,
        )
        # Another line rate or number of sub-steps needs other ticks than the rig's.
        if line_rate is not None or found.substeps != known.substeps:
            rate_hz = known.line_rate_hz if line_rate is None else line_rate
            # Before `clock_of`, which would never end for a rate of 0.
            _check_sizes(found.stages, found.substeps, rate_hz)
            clock_hz, ticks = clock_of(rate_hz, found.substeps)
            found = replace(found, clock_hz=clock_hz, substep_ticks=ticks)
    _check_sizes(found.stages, found.substeps, found.line_rate_hz)
    return found


def _of_options(
    stages: int | None, substeps: int | None, line_rate: float | None, light: Code | None
) -> Instrument:
    from acquire.exchange import Instrument, clock_of

    if stages is None or substeps is None or line_rate is None or light is None:
        given = {"--stages": stages, "--substeps": substeps, "--line-rate": line_rate, "--code": light}
        absent = ", ".join(name for name, value in given.items() if value is None)
        raise UsageError(
            f"the lines cannot be imported without {absent}",
            possible="all of --stages, --substeps, --line-rate and --code, or --config RIG",
        )
    # Before `clock_of`, which would never end for a rate of 0.
    _check_sizes(stages, substeps, line_rate)
    return Instrument(stages, substeps, light, *clock_of(line_rate, substeps), {})


def _check_sizes(stages: int, substeps: int, line_rate_hz: float) -> None:
    # The limits of a rig file, where there is one (`GeometryConfig`).
    for name, value, low, high in (
        ("--stages", stages, 1, 4096),
        ("--substeps", substeps, 1, 8),
        ("--line-rate", line_rate_hz, 1e-3, 1e7),
    ):
        if not low <= value <= high:
            raise UsageError(f"{name} {value:g} is out of range", possible=f"{low:g} to {high:g}")


def _of_rig(name: str) -> Instrument:
    from acquire.config import load_rig
    from acquire.exchange import Instrument

    rig = load_rig(name)
    keys = ("white_dn", "black_level_dn", "responsivity_dn")
    return Instrument(
        stages=rig.geometry.stages,
        substeps=rig.geometry.substeps,
        code=rig.code.build(),
        clock_hz=rig.trigger.clock_hz,
        substep_ticks=rig.trigger.substep_ticks,
        cameras={arm: {key: getattr(rig.cameras.arm(arm), key) for key in keys} for arm in ("a", "b")},
        config=rig.model_dump(mode="json"),
        # Also for a rig of layout compact: --columns-a and --columns-b cut its arms out of the lines.
        layout="dual" if rig.laid_out is None else "fibre",
        fibre=rig.laid_out,
    )
