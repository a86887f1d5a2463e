"""``acquire camera features | snapshot | live``: inspect a camera before it is used."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from acquire.cli.camera_bench import OPEN_S, CameraBench
from acquire.cli.camera_live import live
from acquire.cli.completion import rigs
from acquire.cli.output import JsonFlag, print_facts, print_json, print_table
from acquire.errors import UsageError

ConfigOption = Annotated[
    str | None,
    typer.Option(
        "--config",
        "-c",
        metavar="RIG",
        autocompletion=rigs,
        help="Rig file, or the name of a built-in rig. Default: search all cameras that the GenTL producers "
        "in GENICAM_GENTL64_PATH show.",
    ),
]
SerialArgument = Annotated[
    str, typer.Argument(metavar="SERIAL", help="Serial number of the camera. `acquire devices` lists them.")
]


def register(app: typer.Typer) -> None:
    group = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")
    for command in (features, snapshot, live):
        group.command()(command)
    app.add_typer(
        group,
        name="camera",
        help="Inspect the cameras: their features, a picture, or live readings.",
        rich_help_panel="Rig",
    )


def features(serial: SerialArgument, config: ConfigOption = None, json: JsonFlag = False) -> None:
    """Print every feature of a camera and of its driver: value, access and possible values.

    With a rig file, its settings are written to the camera first.

    Example: [bold]acquire camera features SIM-A --config rig-demo[/]
    """
    from acquire.camera.look import feature_table
    from acquire.camera.visit import visit

    with CameraBench(config) as bench:
        # In a process of its own, which can be ended if the camera's driver hangs.
        rows = visit(bench.opener(serial), feature_table, timeout_s=OPEN_S)
    if json:
        print_json(rows)
        return
    columns = ("module", "feature", "value", "access", "possible")
    print_table(columns, [["" if row.get(c) is None else row.get(c, "") for c in columns] for row in rows])


def snapshot(
    serial: SerialArgument,
    config: ConfigOption = None,
    lines: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of lines in the picture.")] = 1024,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="New file: a picture (.png) or the raw values (.npy). Default: SERIAL.png."
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Save a picture of the next lines of a camera. With a rig file, its trigger runs at the same time.

    In a .png the grey scale is stretched from the darkest to the brightest value; a .npy holds the raw
    values.

    Example: [bold]acquire camera snapshot SIM-A --config rig-demo --lines 500[/]
    """
    import numpy as np

    from acquire.camera.look import snapshot as take
    from acquire.camera.visit import visit
    from acquire.store.delivery import whole_file
    from acquire.store.refusals import refused

    path = out or Path(f"{serial}.png")
    # Before the camera is opened, which takes long.
    _check_out(path)
    is_picture = path.suffix.lower() == ".png"
    if is_picture:
        from PIL import Image  # an extra, which a capture host may not have
    with CameraBench(config) as bench:
        seconds = OPEN_S + lines / bench.line_rate_hz
        # `armed`: the trigger starts only once the camera waits for its pulses.
        pixels, flags = visit(
            bench.opener(serial), take, lines, seconds, timeout_s=2 * OPEN_S + seconds, armed=bench.pulse
        )
    with whole_file(path) as part, refused(path, "written"), part.open("wb") as file:
        if not is_picture:
            np.save(file, pixels)
        else:
            # A picture of a single value has no span to be divided by.
            low, span = int(pixels.min()), max(1, int(pixels.max()) - int(pixels.min()))
            stretched = np.rint((pixels.astype(np.float32) - low) * (255 / span)).astype(np.uint8)
            # An open file has no suffix from which Pillow could take the format.
            Image.fromarray(stretched).save(file, "PNG")
    facts = {
        "picture": str(path),
        "lines": len(pixels),
        "pixels": pixels.shape[1],
        "type": str(pixels.dtype),
        "darkest": int(pixels.min()),
        "brightest": int(pixels.max()),
        "mean": round(float(pixels.mean()), 1),
        "flagged_lines": int((flags != 0).sum()),
    }
    (print_json if json else print_facts)(facts)


def _check_out(path: Path) -> None:
    from acquire.store.files import no_directory

    if path.suffix.lower() not in (".png", ".npy"):
        raise UsageError(
            f"a snapshot cannot be saved as {path.name}: its suffix is not a known format",
            possible=".png, .npy",
            hint=f"--out {path.parent / (path.stem or 'snapshot')}.png",
        )
    if path.exists():
        raise UsageError(
            f"a snapshot cannot be saved to {path}: the file exists and is not overwritten",
            hint="--out with a new file",
        )
    if (no := no_directory(path.absolute().parent)) is not None:
        why, _ = no
        raise UsageError(
            f"a snapshot cannot be saved to {path}: {why}", hint="--out in a directory that exists"
        )
