"""All proofs, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from firmware.formal.frames import frames_proof
from firmware.formal.pulses import pulses_proof
from firmware.formal.requests import requests_proof
from firmware.formal.runs import runs_proof
from firmware.formal.settings import settings_proof
from firmware.formal.tags import tags_proof
from firmware.formal.timing import timing_proof
from firmware.formal.transfer import transfer_proof
from firmware.formal.wiring import wiring_proof
from firmware.formal.witnesses import witnesses_proof

if TYPE_CHECKING:
    from collections.abc import Callable

    from firmware.formal.harness import Proof

PROOFS: dict[str, Callable[[], Proof]] = {
    "timing": timing_proof,
    "pulses": pulses_proof,
    "transfer": transfer_proof,
    "settings": settings_proof,
    "requests": requests_proof,
    "runs": runs_proof,
    "tags": tags_proof,
    "frames": frames_proof,
    "witnesses": witnesses_proof,
    "wiring": wiring_proof,
}
