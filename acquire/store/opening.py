"""Opening recordings, local or remote: a place without one, or damage, is reported before lines are read."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar

from acquire.codes import code_from_attrs
from acquire.errors import DataError, PlaceError, UsageError
from acquire.flags import ARMS
from acquire.reading import OddFileError, parse_object
from acquire.store.array_files import COLUMNS
from acquire.store.attributes import check_attributes
from acquire.store.extent import check_lengths
from acquire.store.layout import DAMAGE, READABLE
from acquire.store.refusals import refusal, refused
from acquire.store.source import source_of
from acquire.text import cause_in_words, unexpanded

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.errors import AcquireError
    from acquire.store.layout import Document
    from acquire.store.outline import Outline
    from acquire.store.source import Source

Kind = TypeVar("Kind", bound="Outline")


_SHOWN_BY = {
    "video": "acquire render, which shows videos",
    "calibration": "acquire calibrate show, which shows calibrations",
}
"""Kinds of groups that are ours and no recordings, as their formats name them, and what shows them."""


def opened(source: Source, kind: type[Kind], document: Document | None = None) -> Kind:
    """Open a source as a `Recording`, or as an `Outline`, which has no lines.

    ``document``: its root, if it has just been read. Raises PlaceError if there is no recording, DataError
    if it is damaged, and StoreError if that cannot be found out.
    """
    # The format comes first: something other than a recording is a wrong path, and not damage.
    document = read_root(source) if document is None else document
    name = stated_format(document)
    if name not in READABLE:
        if name is not None and name.startswith(READABLE[0].split("/")[0] + "/"):
            raise PlaceError(
                f"{source} is a recording of format {name!r}",
                possible=", ".join(map(repr, READABLE)),
                hint="a newer version of acquire",
            )
        of = other_kind(name) or "Zarr group"
        raise PlaceError(
            f"{source} is a {of}, but not a recording: {format_in_words(name)}",
            possible=", ".join(map(repr, READABLE)),
            hint=_SHOWN_BY.get(of, "the path of a recording"),
        )
    try:
        check_attributes(document["attributes"])
        found = kind(source, document)
        _check_complete(found)
        check_lengths(found)
    except (*DAMAGE, UsageError) as error:
        raise DataError(
            f"{source}: the metadata of the recording is damaged: {cause_in_words(error)}",
            hint="a copy of the recording",
        ) from error
    return found


def format_of(place: Path | str) -> str | None:
    """Return the format that a Zarr group states, if any. Raises as `read_root` does."""
    return stated_format(read_root(source_of(place)))


def other_kind(name: str | None) -> str | None:
    """Return what else of ours a group of this format is, in one word; None: a recording, or not ours."""
    return next(
        (kind for kind in _SHOWN_BY if name is not None and name.startswith(f"acquire-{kind}/")), None
    )


def read_root(source: Source) -> Document:
    """Return the root's zarr.json, with attributes.

    Raises PlaceError if there is no Zarr group, DataError if its metadata is damaged or was removed, and
    StoreError if the disk or the store fails.
    """
    try:
        document: Document = parse_object(source.read("zarr.json"))
        _check_object(document["attributes"])
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        raise _no_root(source, error) from error
    except OddFileError as error:
        raise DataError(
            f"{source}: zarr.json is damaged: {error.strerror}", hint="a copy of the recording"
        ) from error
    except OSError as error:
        raise refusal(source, error, "read") from error
    except (ValueError, LookupError, TypeError) as error:
        raise DataError(f"{source}: zarr.json is damaged: {error}", hint="a copy of the recording") from error
    return document


def _no_root(source: Source, error: OSError) -> AcquireError:
    """Return the error for missing root metadata: nothing there, something else, or a damaged recording."""
    hint = "the path or URL of a directory NAME.zarr; `acquire ls DIR` lists those of a directory"
    with refused(source, "read"):
        if not source.exists():
            return PlaceError(f"{source} does not exist", hint=unexpanded(source) or hint)
        with suppress(FileNotFoundError, NotADirectoryError):
            source.size(f"{ARMS[0]}/lines/zarr.json")
            return DataError(
                f"{source} is a recording whose root metadata, zarr.json, is missing",
                hint=f"acquire recover {source}; the lines themselves are still in a/ and b/",
            )
    if is_file(error):
        return PlaceError(f"{source} is not a recording: it is a file", hint=hint)
    return PlaceError(f"{source} is not a recording: it holds no zarr.json", hint=hint)


def is_file(error: BaseException | None) -> bool:
    """Return whether a root document could not be read because the place is a file."""
    return isinstance(error, NotADirectoryError)


def format_in_words(name: object) -> str:
    """Return the format that a root document states, as a clause."""
    return f"its format is {name!r}" if name is not None else "it states no format"


def _check_object(attributes: Any) -> None:
    if not isinstance(attributes, dict):
        raise TypeError("its attributes are not a JSON object")


def stated_format(document: Document) -> str | None:
    """Return the format that a root document states, if any."""
    name = document["attributes"].get("format")
    return name if isinstance(name, str) else None


def _check_complete(recording: Outline) -> None:
    """Check everything that a recording needs; raise DAMAGE or UsageError for missing or impossible parts."""
    code_from_attrs(recording.attrs["code"])
    recording.geometry_for(1)
    for path, node in recording.document["consolidated_metadata"]["metadata"].items():
        # Files are found by these paths, which must not lead out of the recording.
        if not all(part and part not in (".", "..") and "\0" not in part for part in path.split("/")):
            raise ValueError(f"{path!r} is not the path of an array or a group")
        _check_object(node["attributes"])
        node["node_type"]  # a KeyError, if there is none
    for table in ("gaps", "events"):
        int(recording.document["consolidated_metadata"]["metadata"][table]["attributes"]["not_listed"])
    for arm in recording.arms.values():
        for name in COLUMNS:
            if len(arm.files(name).shape.chunk_shape) != (2 if name == "lines" else 1):
                raise ValueError(f"{arm.arm}/{name} has the wrong number of axes")
