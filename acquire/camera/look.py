"""Inspection of one camera for users: identity, features, a snapshot. Runs in the camera's process."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from acquire.camera.settings import describe
from acquire.errors import CameraError
from acquire.lines import LineFlag
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from acquire.camera.base import Camera
    from acquire.camera.settings import Node

_WAIT_S = 0.1


class FeatureTree(Protocol):
    """The features of one module by category."""

    def find(self, name: str) -> Node | None:
        """Return the feature of that name; None if there is none."""
        ...

    def categories(self) -> Mapping[str, list[str]]:
        """Return category → its features, in the order of the camera's description."""
        ...


@runtime_checkable
class FeatureCamera(Protocol):
    """A camera that can show its features."""

    def features(self) -> Mapping[str, FeatureTree]:
        """Return module (``remote``, ``stream`` …) → its features."""
        ...


def facts(camera: Camera, _: Callable[[], None]) -> dict[str, Any]:
    """Return identity and settings as read back."""
    return {"identity": asdict(camera.identify()), "settings": camera.settings()}


def feature_table(camera: Camera, _: Callable[[], None]) -> list[dict[str, Any]]:
    """Return a row per feature, in the camera's order: module, category, feature, value, access, kind,
    possible.
    """
    if isinstance(camera, FeatureCamera):
        return [
            {"module": module, "category": category, "feature": name, **_row(node)}
            for module, tree in camera.features().items()
            for category, names in tree.categories().items()
            for name in names
            if (node := tree.find(name)) is not None
        ]
    return [
        {"module": "remote", "category": "", "feature": name, "value": value}
        for name, value in camera.settings().items()
    ]


def _row(node: Node) -> dict[str, Any]:
    row: dict[str, Any] = {"value": None, "access": "", "kind": node.kind, "possible": ""}
    with suppress(CameraError):  # a defective feature must not hide the others
        row["access"] = ("r" if node.readable else "") + ("w" if node.writable else "")
        row["value"] = node.read() if node.readable else None
        row["possible"] = describe(node) if node.writable else ""
    return row


def snapshot(
    camera: Camera, armed: Callable[[], None], lines: int, timeout_s: float
) -> tuple[NDArray[Any], NDArray[np.uint16]]:
    """Return the next ``lines`` lines (line, pixel) and their flags (line).

    ``armed`` is called once the camera is armed. Lines that the camera lost are 0 and flagged missing. Raises
    CameraError if they do not come in time.
    """
    camera.arm()
    armed()
    deadline = time.monotonic() + timeout_s
    pixels: NDArray[Any] | None = None
    flags = np.full(lines, LineFlag.MISSING, np.uint16)
    end = 0
    while end < lines:
        if time.monotonic() > deadline:
            raise CameraError(
                f"only {end} of {counted(lines, 'line')} came in {timeout_s:g} s",
                hint="check the line triggers, or set TriggerMode to Off (acquire camera features)",
            )
        block = camera.next_block(_WAIT_S)
        if block is None:
            continue
        if pixels is None:
            pixels = np.zeros((lines, block.pixels.shape[1]), block.pixels.dtype)
        first, end = block.first_line, block.first_line + len(block.flags)
        pixels[first:end] = block.pixels[: max(0, lines - first)]
        flags[first:end] = block.flags[: max(0, lines - first)]
        camera.release(block)
    camera.disarm()
    assert pixels is not None
    return pixels, flags
