"""``acquire calibrate sheet``: draw the target that shows everything, to be printed or shown."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from acquire.cli.completion import rigs
from acquire.cli.output import JsonFlag, print_facts, print_json
from acquire.errors import UsageError
from acquire.text import counted

FORMATS = (".svg", ".png")
LARGEST_PIXELS = 4096
"""Most pixels of a .png per side: more than screens have, and a few seconds to draw."""


def sheet(
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="File to write: .svg to be printed, or .png with what the cameras see of it, to be shown or "
            "simulated.",
        ),
    ],
    field_mm: Annotated[
        float,
        typer.Option(
            "--field-mm", min=0.1, max=10_000, metavar="MM", help="Side of what the cameras see of it."
        ),
    ] = 100.0,
    config: Annotated[
        str,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file, or the name of a built-in rig: its numbers of stages and sub-steps count.",
        ),
    ] = "rig-demo",
    json: JsonFlag = False,
) -> None:
    """Draw the target from which orientation, alignment, blur and veil are measured in one recording.

    It has dots of 2 to 6 fine pixels, slanted squares, and dark patches, all bright on dark. Measure how much
    of the target's plane the cameras see and give it as --field-mm. Print the .svg at 100 %, so sharp that a
    fine pixel is several of the printer's dots, on film or glass to be lit from behind, or on matt paper.
    Printed black on paper reflects light, so that the veil cannot be measured from it.

    Example: [bold]acquire calibrate sheet --out target.svg --field-mm 60 --config rig.toml[/]
    """
    from acquire.calibrate.sheet import FINER, svg
    from acquire.config import load_rig
    from acquire.store.delivery import whole_file
    from acquire.store.refusals import refused

    suffix = out.suffix.lower()
    _check_out(out, suffix)
    geometry = load_rig(config).geometry
    n = geometry.stages * geometry.substeps
    if suffix == ".svg":
        data, size = (
            svg(geometry.substeps, geometry.stages, field_mm).encode("utf-8"),
            f"{field_mm / n:.3g} mm",
        )
    else:
        # A picture has no millimetres: it is as wide as the screen or printer that shows it makes it.
        finer = max(1, min(FINER, LARGEST_PIXELS // n))
        data, size = _png(geometry.substeps, n, finer), counted(finer, "pixel")
    with whole_file(out) as part, refused(out, "written"):
        part.write_bytes(data)
    facts = {"sheet": str(out), "fine pixels": n, "a fine pixel": size}
    (print_json if json else print_facts)(facts)


def _png(substeps: int, size: int, finer: int) -> bytes:
    """Return a picture of the field, with ``finer`` pixels per fine pixel."""
    import io

    import numpy as np
    from PIL import Image  # an extra, which a capture host may not have

    from acquire.calibrate.sheet import FINER, Sheet

    light = Sheet(substeps).picture(size * finer, finer=max(1, FINER // finer), scale=finer)
    file = io.BytesIO()
    Image.fromarray(np.rint(255 * light).astype(np.uint8)).save(file, "PNG", optimize=True)
    return file.getvalue()


def _check_out(path: Path, suffix: str) -> None:
    if suffix not in FORMATS:
        raise UsageError(
            f"the sheet cannot be drawn as {path.name}: its suffix is not a known format",
            possible=", ".join(FORMATS),
            hint=f"--out {path.with_suffix('.svg')}" if path.stem else "--out target.svg",
        )
    if path.exists():
        raise UsageError(
            f"the sheet cannot be drawn to {path}: the file exists and is not overwritten",
            hint="--out with a new file",
        )
