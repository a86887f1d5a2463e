"""What is recorded of a result: of a sub-segment of a stitched video, and of a whole one in memory."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.recon.error import error_facts
from acquire.recon.judge import POOR_MISFIT
from acquire.text import counted

if TYPE_CHECKING:
    from acquire.recon import Reconstruction


def result_facts(result: Reconstruction) -> dict[str, Any]:
    """Return how a result came about and how good it is, as JSON: what is not finite is None."""
    return {
        "iterations": result.iterations,
        "iterations_asked": result.iterations_asked,
        "ended": result.ended,
        "seconds": round(result.seconds, 3),
        "processor_s": round(result.processor_s, 3),
        "compiled_s": round(result.compiled_s, 3),
        "masked": result.masked,
        "parameters": result.parameters,
        "error": error_facts(result.error),
        "quality": {
            name: None if isinstance(value, float) and not np.isfinite(value) else value
            for name, value in asdict(result.quality).items()
        },
    }


def why_not_trusted(result: Reconstruction, what: str) -> str | None:
    """Return why no frame is trusted, or None: the run was stopped, or too short to explain its lines.

    ``what`` was solved, with its lines: "the video of lines 0 to 9".
    """
    if not result.believed:
        return "no frame of it is trusted: the lines contradict the recording's description of them"
    # A run ended by its budget is trusted if it explains its lines; one that was stopped never is.
    missed = float(np.nanmax([result.quality.misfit, result.quality.prediction]))
    if result.ended != "stopped" and (result.ended != "budget" or missed <= POOR_MISFIT):
        return None
    ended = "stopped" if result.ended == "stopped" else "ended by its budget"
    ran = counted(result.iterations, "iteration")
    return f"{what} was {ended} after {ran} and leaves a misfit of {missed:.0%}: it is not trusted"
