"""The steps of a calibration as somebody does them: what to put in front of the lens, and how many lines.

In the order in which a new instrument needs them. The command line and the operator's page both ask here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Step:
    """One sitting: what to do before it, its light, and the steps of a calibration that it finds.

    Attributes
    ----------
    lines : of each recording, unless somebody says otherwise; None: as many as it takes
    least_lines : fewer are refused
    code : what the light follows, as in `acquire.client.Client.arm`
    after : name of the step that it needs; empty: none
    """

    name: str
    prepare: str
    lines: int | None
    code: Literal["rig", "dark", "steady"]
    finds: tuple[str, ...]
    least_lines: int = 64
    after: str = ""


MOST_LINES = 2**20
LINES = 1024
"""That each recording has; see `acquire calibrate dark --help` and its neighbours for what they give."""
RAMP_LINES = 512
"""A mean over a camera's columns to a part in 10⁴, as steady as lamps are from one recording to the next."""
LEAST_SWEEP_LINES = 1024

DELAY = Step(
    "delay",
    "Put a bright scene in, at rest, larger than the field, as for the flat; it need not be uniform.",
    None,
    "rig",
    ("delay",),
    LEAST_SWEEP_LINES,
)
DARK = Step("dark", "Leave everything as in use; the light stays off.", LINES, "dark", ("dark",))
LINEARITY = Step(
    "linearity",
    "Put a white scene in, at rest; steady light at 80 % of white or more, if need be just saturated.",
    RAMP_LINES,
    "steady",
    ("linearity", "transfer"),
    after="dark",
)
FLAT = Step(
    "flat",
    "Put a uniform white scene in, larger than the field; the light stays on, best at 50 to 70 % of it.",
    LINES,
    "steady",
    ("flat", "transfer"),
    after="dark",
)
TARGET = Step(
    "target",
    "Put a target in, at rest, with sharp, irregular texture: dots or bars of 2 to 6 fine pixels.",
    LINES,
    "rig",
    ("orientation", "align"),
)
PSF = Step(
    "psf",
    "Put a square or a checkerboard in, at rest and in focus, turned by 3 to 20 degrees, its edges 30 fine "
    "pixels or more from one another.",
    LINES,
    "rig",
    ("psf",),
)
"""Not after dark or flat: it asks how wide edges are, which columns that differ by 3 % leave as it is."""
STEPS = (DELAY, DARK, LINEARITY, FLAT, TARGET, PSF)
AT_ONCE = (DARK, FLAT, TARGET)
"""Those of `acquire calibrate all`, of one recording each."""
WHERE_WANTED = (PSF,)
"""Of one recording each, too, after those, and only where somebody asks for them."""
