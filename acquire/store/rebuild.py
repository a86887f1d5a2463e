"""Rebuilding a lost root zarr.json of a recording from the metadata of the parts below it.

::

    a/lines/.attributes          copy of the root's attributes ────┐
    a/*, b/*, gaps/*, events/*   each array's own zarr.json ───────┴▶ zarr.json

The copy of the attributes is written before the first line, and again when retention drops lines and when the
recording is sealed. Arrays state their lengths to within a second: `recover` finds lines on disk beyond that.
Recordings of versions that kept no copy cannot be rebuilt, but their arms can be read.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

from acquire.errors import DataError
from acquire.lines import ARMS
from acquire.reading import read_object
from acquire.store import layout, overview
from acquire.store.files import SCRATCH, Publisher
from acquire.store.listing import COPY, ROOT
from acquire.store.refusals import CURES
from acquire.store.table import event_table, gap_table
from acquire.text import cause_in_words

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.store.files import Disk

LOST_FACTS = "run_id, first_line, geometry, code, clock, cameras, trigger, config"
"""Facts that are stored only in the root and its copy."""
DAMAGED_ROOT = "zarr.json.damaged"
"""New name of a root that cannot be read."""


def root_is_lost(path: Path) -> bool:
    """Return whether a recording's arms are there, but not a root that is a JSON object with attributes."""
    if not any((path / arm).is_dir() for arm in ARMS):
        return False
    try:
        return not isinstance(read_object(path / ROOT).get("attributes"), dict)
    except (FileNotFoundError, ValueError):
        return True
    except OSError:
        return False  # it may be intact: opening it reports the error


def known_attributes(path: Path) -> dict[str, Any] | None:
    """Return the root's attributes, or else their copy; None if there is neither."""
    for file in (path / ROOT, path / ARMS[0] / "lines" / COPY):
        with suppress(OSError, ValueError):
            if isinstance(attributes := read_object(file, follow=False).get("attributes"), dict):
                return attributes
    return None


def write_copy(publisher: Publisher, path: Path, attributes: dict[str, Any], *, durable: bool) -> None:
    """Write the copy of the root's attributes. Raises OSError."""
    text = layout.to_json({"attributes": attributes})
    publisher.replace(path / ARMS[0] / "lines" / COPY, text, durable=durable)


def rebuild_root(path: Path, disk: Disk) -> None:
    """Rebuild the root of the recording at ``path``; one that cannot be read is kept under another name.

    Tables whose metadata are lost are empty, and named in ``tables_lost``.
    Raises DataError, and changes nothing, if too much is lost.
    """
    attributes = known_attributes(path)
    if attributes is None:
        raise DataError(
            f"{path}: its root zarr.json is lost, and with it {LOST_FACTS}",
            possible=f"the arrays of {' and '.join(ARMS)} can be read with zarr; nothing was touched",
            hint="a copy of the recording, or of its zarr.json",
        )
    tables = {"gaps": gap_table(path).nodes(), "events": event_table(path).nodes()}
    nodes = _arms(path, attributes) | tables["gaps"] | tables["events"]
    # Tables and overview as far as they exist, since the lines do not depend on them.
    lost: dict[str, str] = {}
    for name, keys in (*tables.items(), (overview.NAME, overview.KEYS)):
        own = {key: _own(path / key) for key in keys}
        if all(own.values()):
            nodes |= {key: layout.inner(document) for key, document in own.items() if document}
        elif name in tables:
            key = next(key for key, document in own.items() if not document)
            lost[name] = f"table {name} is lost: {key}/zarr.json cannot be read"
    if lost:
        attributes = {**attributes, "tables_lost": lost}
    try:
        if (path / ROOT).exists():
            disk.rename(path / ROOT, path / DAMAGED_ROOT)
        publisher = Publisher(path / ARMS[0] / "lines" / SCRATCH, disk)
        publisher.replace(path / ROOT, layout.to_json(layout.group_document(attributes, nodes)), durable=True)
    except OSError as error:
        cure = CURES.get(error.errno or 0, "the kernel's log for errors of the disk")
        raise DataError(
            f"{path}: its root cannot be rebuilt: {error.strerror or error}",
            hint=f"{cure}; then acquire recover again",
        ) from error


def _arms(path: Path, attributes: dict[str, Any]) -> dict[str, layout.Document]:
    """Return the metadata of both arms, with the rows that all arrays have; whole chunks unless sealed."""
    nodes: dict[str, layout.Document] = {}
    for column in layout.line_columns("any"):
        # Arrays of one column are alike in both arms: either may stand in for the other.
        found = [_own(path / arm / column.name) for arm in ARMS]
        known = next(filter(None, found), None)
        if known is None:
            raise DataError(
                f"{path}: its root zarr.json is lost, and what the arrays {column.name} of both arms are",
                possible="the other arrays can be read with zarr; nothing was touched",
                hint="a copy of the recording, or of its zarr.json",
            )
        for arm, own in zip(ARMS, found, strict=True):
            nodes[f"{arm}/{column.name}"] = own or known
    try:
        shapes = {key: layout.parse_line_array(node) for key, node in nodes.items()}
        rows = min(rows for _, rows in shapes.values())
        if attributes.get("state") != "sealed":
            # Only `seal` writes a part of a chunk: until then the newest rows of an array are whole chunks.
            rows -= rows % max(shape.chunk_rows for shape, _ in shapes.values())
            # Lines that retention dropped were committed, although an array may not state them yet.
            first_line = int(attributes["first_line"])
            dropped = (int(first) + int(count) for first, count in attributes.get("dropped", ()))
            rows = max([rows, *(end - first_line for end in dropped)])
        for key in shapes:
            nodes[key] = nodes[key] | {"shape": [rows, *nodes[key]["shape"][1:]]}
        group = {"first_line": int(attributes["first_line"])}
    except layout.PARSE_ERRORS as error:
        raise DataError(
            f"{path}: its root zarr.json is lost, and its arrays are damaged: {cause_in_words(error)}",
            hint="a copy of the recording, or of its zarr.json",
        ) from error
    ordered: dict[str, layout.Document] = {}  # zarr relies on a group being followed by its members
    for arm in ARMS:
        ordered[arm] = layout.group_document({"arm": arm, **group}, {})
        ordered |= {key: node for key, node in nodes.items() if key.startswith(f"{arm}/")}
    return ordered


def _own(directory: Path) -> layout.Document | None:
    """Return the own metadata of an array or a group, if it can be read."""
    try:
        document = read_object(directory / ROOT, follow=False)
    except (OSError, ValueError):
        return None
    return document if isinstance(document.get("attributes"), dict) and document.get("node_type") else None
