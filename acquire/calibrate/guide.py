"""The steps of a calibration for the person who does them: what to put in front of the lens, how many lines.

They are in the order in which a new instrument needs them. Both the command line and the operator's page use
this list.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Literal


@dataclass(frozen=True)
class Step:
    """One session: its preparation, its light, and the calibration steps that it completes.

    Attributes
    ----------
    lines : default for each recording; None means as many as needed
    least_lines : fewer are refused
    code : the light's code, as in `acquire.client.Client.arm`
    after : name of the step that must precede it, or empty
    tries : further steps that its recording completes if its scene shows what they measure
    """

    name: str
    prepare: str
    _: KW_ONLY
    lines: int | None
    code: Literal["rig", "dark", "steady"]
    finds: tuple[str, ...]
    least_lines: int = 64
    after: str = ""
    tries: tuple[str, ...] = ()


MOST_LINES = 2**20
LINES = 1024
"""Lines per recording; see `acquire calibrate dark --help` and the other steps for the precision."""
NOISE_LINES = 4096
"""Lines from which noise is measured: on 64 columns they give the DN per electron to 0.3 %."""
RAMP_LINES = 512
"""Lines for a mean over the columns to a part in 10⁴, the stability of lamps between recordings."""
LEAST_SWEEP_LINES = 1024
PER_ROW = 4
"""Least default lines per fine row of the sensor, for images of a scene at rest. On 128 stages with 3
sub-steps the veil from 1024 lines was uncertain by 0.31 % of the light, from 1536, four per row, by 0.22 %.
"""

DELAY = Step(
    "delay",
    "Put a bright scene in, at rest, larger than the field, as for the flat; it need not be uniform.",
    lines=None,
    code="rig",
    finds=("delay",),
    least_lines=LEAST_SWEEP_LINES,
)
DARK = Step(
    "dark",
    "Leave everything as in use; the light stays off.",
    lines=NOISE_LINES,
    code="dark",
    finds=("dark",),
)
LINEARITY = Step(
    "linearity",
    "Put a white scene in, at rest; steady light at 80 % of white or more, if need be just saturated.",
    lines=RAMP_LINES,
    code="steady",
    finds=("linearity", "transfer"),
    after="dark",
)
FLAT = Step(
    "flat",
    "Put a uniform white scene in, larger than the field; the light stays on, best at 50 to 70 % of it.",
    lines=NOISE_LINES,
    code="steady",
    finds=("flat", "transfer"),
    after="dark",
)
TARGET = Step(
    "target",
    "Put a target in, at rest and in focus, with sharp, irregular texture: dots or bars of 2 to 6 fine "
    "pixels. The one that acquire calibrate sheet draws also has slanted squares, which show the blur.",
    lines=LINES,
    code="rig",
    finds=("orientation", "align"),
    tries=("psf",),
)
BLACK = (
    "The target's dark parts send no light at all, as those of chrome on glass or film lit from behind: also "
    "measure the lens's veil from it. Not for printed black."
)
"""What somebody says who has the target's recording show the veil, too."""
PSF = Step(
    "psf",
    "Put a square or a checkerboard in, at rest and in focus, turned by 3 to 20 degrees, its edges 30 fine "
    "pixels or more from one another.",
    lines=LINES,
    code="rig",
    finds=("psf",),
)
"""It needs neither dark nor flat, since columns that differ by 3 % do not change the width of edges."""
VEIL = Step(
    "veil",
    "Put a target in, at rest, a few percent of which send no light at all: holes in a white card before a "
    "dark room, or chrome on glass lit from behind. Printed black is not black enough.",
    lines=NOISE_LINES,
    code="rig",
    finds=("veil",),
    after="dark",
)
STEPS = (DELAY, DARK, LINEARITY, FLAT, TARGET, PSF, VEIL)
AT_ONCE = (DARK, FLAT, TARGET)
"""The steps of `acquire calibrate all`, with one recording each."""
OPTIONAL = (PSF, VEIL)
"""Optional steps after those, with one recording each."""


def lines_of(step: Step, rows: int) -> int | None:
    """Return a step's default number of lines on a sensor that sees ``rows`` fine rows (n = M·S).

    Images of a scene at rest have as many unknowns per column as rows, so that large sensors need more lines.
    """
    return step.lines if step.lines is None or step.code != "rig" else max(step.lines, PER_ROW * rows)
