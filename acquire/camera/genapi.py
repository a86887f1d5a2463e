"""Features of a camera's own description: GenApi node maps, through the genicam package.

genicam is imported when first used, never with this module: importing it changes warning filters.
"""

from __future__ import annotations

import logging
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from acquire.camera.settings import await_done
from acquire.errors import CameraError, CameraLostError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.camera.settings import Kind, Value

_KINDS: dict[str, Kind] = {
    "intfIInteger": "integer",
    "intfIFloat": "float",
    "intfIEnumeration": "enumeration",
    "intfIBoolean": "boolean",
    "intfIString": "text",
    "intfICommand": "command",
}
_log = logging.getLogger(__name__)


class GenapiFeatures:
    """`acquire.camera.settings.Features` of a node map."""

    def __init__(self, node_map: Any) -> None:
        self._map = node_map
        self._nodes: dict[str, GenapiNode] = {}

    def find(self, name: str) -> GenapiNode | None:
        """Return the feature, looked up once; None if the description has none of that name."""
        if name not in self._nodes:
            from genicam import genapi

            try:
                self._nodes[name] = GenapiNode(self._map.get_node(name))
            except genapi.GenericException:
                return None
        return self._nodes[name]

    def names(self) -> list[str]:
        """Return the features of all categories; others are not meant for users."""
        return [name for names in self.categories().values() for name in names]

    def categories(self) -> dict[str, list[str]]:
        """Return, per category, its features in the order of the description."""
        found: dict[str, list[str]] = {}
        with translated("read the features"):
            self._collect(self._map.get_node("Root"), "Root", found)
        return found

    def _collect(self, category: Any, name: str, found: dict[str, list[str]]) -> None:
        from genicam import genapi

        for feature in category.features:
            if feature.node.principal_interface_type == genapi.EInterfaceType.intfICategory:
                # A category may be listed in several, and a description may even name one within itself.
                if feature.node.name not in found:
                    self._collect(feature, feature.node.name, found)
            elif feature.node.name not in found.setdefault(name, []):
                found[name].append(feature.node.name)


class GenapiNode:
    """`acquire.camera.settings.Node` of a GenApi node."""

    def __init__(self, node: Any) -> None:
        from genicam import genapi

        self._node = node
        self.name: str = node.node.name
        self.kind: Kind = _KINDS.get(genapi.EInterfaceType(node.node.principal_interface_type).name, "other")

    @property
    def readable(self) -> bool:
        """Whether the access mode allows reading, which may depend on other features."""
        return self.kind not in ("command", "other") and self._mode in ("RO", "RW")

    @property
    def writable(self) -> bool:
        """Whether the access mode allows writing, which may depend on other features."""
        return self._mode in ("WO", "RW")

    @property
    def _mode(self) -> str:
        from genicam import genapi

        with translated(self.name):
            return str(genapi.EAccessMode(self._node.get_access_mode()).name)

    @property
    def selected(self) -> bool:
        """Whether another feature selects what it is a value of."""
        with translated(self.name):
            return bool(self._node.node.selecting_features)

    @property
    def about(self) -> str:
        """The camera's description of the feature."""
        return str(self._node.node.tooltip or self._node.node.description)

    def read(self) -> Value:
        """Return the value, possibly from the cache of the node map; see `read_afresh`."""
        with translated(f"read {self.name}"):
            value: Value = self._node.value
            return value

    def read_afresh(self) -> None:
        """Read the register itself, not a cached value."""
        with translated(f"read {self.name}"):
            self._node.node.invalidate_node()
            self._node.to_string()

    def write(self, value: Value) -> None:
        """Set the value; of a command, True executes it and waits, for a bounded time."""
        with translated(f"set {self.name} to {value!r}"):
            if self.kind != "command":
                self._node.value = value
            elif value:
                self._node.execute()
                await_done(self.name, self._node.is_done)

    def limits(self) -> tuple[float, float, float]:
        """Return minimum, maximum and increment, which is 0 for a float without one."""
        with translated(self.name):
            if self.kind == "integer":
                return self._node.min, self._node.max, self._node.inc
            return self._node.min, self._node.max, self._node.inc if self._node.has_inc() else 0

    def entries(self) -> list[str]:
        """Return the names of the enumeration's values."""
        with translated(self.name):
            return list(self._node.symbolics)


class Words(logging.Handler):
    """Keeps messages that harvesters only logs, for example about a description that cannot be parsed."""

    def __init__(self) -> None:
        super().__init__()
        self._last: deque[str] = deque(maxlen=3)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the first line of a message, which for harvesters says what failed."""
        text = record.getMessage().splitlines()
        if text:
            self._last.append(text[0])
            _log.debug("harvesters: %s", text[0])

    @property
    def last(self) -> str:
        """The first line of the latest message; empty before the first one."""
        return self._last[-1] if self._last else ""


def is_gone(error: Exception) -> bool:
    """Return whether a GenTL error means that the device has been lost, and not that a call was wrong."""
    from genicam import gentl

    return isinstance(error, gentl.IoException | gentl.InvalidHandleException | gentl.ClosedException)


@contextmanager
def translated(what: str, words: Words | None = None) -> Iterator[None]:
    """Translate errors of the libraries: to CameraLostError if the device is gone, otherwise CameraError."""
    try:
        from genicam import genapi, gentl
    except ImportError as error:
        raise CameraError(
            f"genicam cannot be imported: {error}", hint="pip install harvesters genicam"
        ) from error
    try:
        yield
    except (genapi.GenericException, gentl.GenericException, ValueError) as error:
        kind = CameraLostError if is_gone(error) else CameraError
        raise kind(f"{what}: {error}", hint=words.last if words else "") from error
