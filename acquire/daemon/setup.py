"""The daemon's setup: configuration, versions, the places of its rings."""

from __future__ import annotations

import contextlib
import os
import platform
from dataclasses import asdict
from importlib import metadata
from typing import TYPE_CHECKING, Any

from acquire import __version__
from acquire.daemon.facts import RingPlace, Rings, Setup, Version
from acquire.lines import ARMS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pydantic import BaseModel

    from acquire.config import RigConfig
    from acquire.daemon.facts import DeviceFacts
    from acquire.daemon.service import Service

LIBRARIES = (
    "numpy",
    "zarr",
    "numcodecs",
    "fastcrc",
    "pydantic",
    "fastapi",
    "uvicorn",
    "harvesters",
    "genicam",
)


def version_of(config: RigConfig) -> Version:
    return Version(acquire=__version__, name=config.name, pid=os.getpid(), python=platform.python_version())


def setup_of(config: RigConfig, origin: str, devices: Sequence[DeviceFacts] = ()) -> Setup:
    """Return the whole setup, read from the file ``origin``; it holds no secrets (`config.recording`)."""
    rate_hz = config.line_rate_hz
    versions = {"acquire": __version__, "python": platform.python_version()}
    for name in LIBRARIES:
        # Those of the cameras are not installed on every platform.
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return Setup(
        name=config.name,
        file=origin,
        config=config.model_dump(mode="json"),
        changed=dict(_changed(config)),
        line_rate_hz=rate_hz * config.simulation.speed,
        line_period_ns=1e9 / rate_hz,
        white_dn=config.cameras.a.white_dn,
        black_dn={arm: config.cameras.arm(arm).black_level_dn for arm in ARMS},
        history_s=config.history_s,
        versions=versions,
        devices=list(devices),
    )


def rings_of(service: Service) -> Rings:
    """Return the places of the rings; empty while nothing is armed."""
    run_id, places = service.ring_places()
    arms = {arm: RingPlace(path=path, **asdict(shape)) for arm, (path, shape) in places.items()}
    return Rings(run_id=run_id, arms=arms)


def _changed(model: BaseModel, prefix: str = "") -> list[tuple[str, Any]]:
    """Return the dotted keys that differ from the default, with their values."""
    found: list[tuple[str, Any]] = []
    dumped = model.model_dump(mode="json")
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if hasattr(value, "model_fields_set"):
            found += _changed(value, f"{prefix}{name}.")
        elif field.is_required() or value != field.get_default(call_default_factory=True):
            found.append((f"{prefix}{name}", dumped[name]))
    return found
