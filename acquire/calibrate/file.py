"""A calibration on disk: a Zarr v3 group whose arrays open in zarr-python and xarray without this program.

::

    NAME.zarr/   attributes: format, instrument, orientation, alignment, steps (how and when each was done)
      gain       (arm, column) float64, with ``units`` and ``long_name``; likewise every measured quantity
      gain_uncertainty
"""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.errors import GroupNotFoundError

from acquire.calibrate.calibration import FORMAT, QUANTITIES, Calibration, Measured
from acquire.errors import AcquireError, DataError, PlaceError, UsageError
from acquire.store.camera_stream import child_array
from acquire.store.delivery import check_new_file, check_new_place, delivery_to
from acquire.store.files import DISK, check_new_path
from acquire.store.layout import DAMAGE, group_document, to_json
from acquire.store.opening import format_in_words, is_file, read_root
from acquire.store.refusals import refused
from acquire.store.remote import is_url
from acquire.store.source import LocalSource, source_of
from acquire.store.swap import BEFORE, alone, beside, clear_left_over, left_over, put_back, swap_in
from acquire.text import unexpanded, visible

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.store.delivery import Delivery
    from acquire.store.source import Source

UNCERTAINTY = "_uncertainty"
ROOT = "zarr.json"
HINT = "the path of a calibration (a directory NAME.zarr), as `acquire calibrate dark … --out` writes it"

COPY = "the copy that a recording carries, as acquire calibrate show RECORDING shows it"
AGAIN = "another copy of the calibration, or measure it again"

log = logging.getLogger("acquire.calibrate")


def save_calibration(place: Path | str, calibration: Calibration) -> None:
    """Write a calibration. An existing one is replaced as a whole; anything else is refused.

    Raises UsageError if it cannot be written, StoreError if the disk refuses.
    """
    change_calibration(place, lambda _: calibration, new=calibration)


def change_calibration(
    place: Path | str, change: Callable[[Calibration], Calibration], *, new: Calibration | None = None
) -> Calibration:
    """Replace the calibration at a place by what ``change`` makes of it, and return that.

    ``new`` is what is changed if there is none. From reading to writing no other process writes, so that none
    loses what another has added. Raises what `open_calibration` and ``change`` raise, and the errors of
    `save_calibration`.
    """
    if is_url(place):
        # Nothing is replaced there.
        found = change(open_calibration(place) if new is None or source_of(place).exists() else new)
        _deliver(delivery_to(place), place, found)
        return found
    path = _path(place)
    with alone(path) as certain:
        _put_back(path)
        # Only a calibration is replaced: anything else raises here.
        found = change(_opened(LocalSource(path)) if new is None or os.path.lexists(path) else new)
        if not os.path.lexists(path):
            check_new_path(path)
        fresh = beside(path)
        try:
            with refused(path, "written"):
                _write(fresh, found)
                swap_in(fresh, path)
        finally:
            DISK.remove_tree(fresh)
        if certain:
            clear_left_over(path)
    return found


def check_calibration_place(place: Path | str) -> None:
    """Raise what `save_calibration` would raise, before the recordings are made and evaluated."""
    if is_url(place):
        check_new_place(place)
        return
    path = _path(place)
    _put_back_if_missing(path)
    if not os.path.lexists(path):
        check_new_place(path)
        return
    open_calibration(path)
    # It is replaced from beside it, so that its directory has to be writable, too.
    check_new_file(beside(path))


def open_calibration(place: Path | str) -> Calibration:
    """Open a calibration, here or at a URL.

    Raises PlaceError if there is none, DataError if it is damaged, StoreError if the store cannot be read.
    """
    source = source_of(place)
    if isinstance(source, LocalSource):
        _put_back_if_missing(_path(source.path))
    while True:
        stamp = _stamp(source)
        try:
            found = _opened(source)
        except AcquireError:
            if _stamp(source) == stamp:
                raise
        else:
            if _stamp(source) == stamp:
                return found
        # It was replaced while it was read: half of each is neither.


def _path(place: Path | str) -> Path:
    """Return the path of a calibration itself, to which a link may lead."""
    path = Path(place)
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def _stamp(source: Source) -> tuple[int, ...]:
    if not isinstance(source, LocalSource):
        return ()
    try:
        found = (source.path / ROOT).stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_mtime_ns


def _put_back_if_missing(path: Path) -> None:
    if not os.path.lexists(path) and left_over(path, BEFORE):
        # One that is being replaced at this moment is there once its process has ended.
        with alone(path):
            _put_back(path)


def _put_back(path: Path) -> None:
    if put_back(path, lambda old: _opened(LocalSource(old))):
        log.warning(
            "%s was put back: a process was killed while it replaced it, and what it added is not in it",
            visible(path),
        )


def _opened(source: Source) -> Calibration:
    with refused(source, "read"):
        there = source.exists()
    if not there:
        raise PlaceError(f"{source} does not exist", hint=unexpanded(source) or HINT)
    try:
        attributes = read_root(source)["attributes"]
    except PlaceError as error:
        if isinstance(error.__cause__, PermissionError):
            raise
        why = "it is a file" if is_file(error.__cause__) else "it holds no zarr.json"
        raise PlaceError(f"{source} is not a calibration: {why}", hint=HINT) from error
    if attributes.get("format") != FORMAT:
        raise PlaceError(
            f"{source} is not a calibration: {format_in_words(attributes.get('format'))}",
            possible=f"{FORMAT!r}",
            hint=HINT,
        )
    try:
        group = zarr.open_group(source.zarr_store(), mode="r", zarr_format=3)
        quantities, name = {}, "its list of arrays"
        for name in [each for each in QUANTITIES if each in group]:
            quantities[name] = Measured(_read(group, name), _read(group, name + UNCERTAINTY))
    except (GroupNotFoundError, *DAMAGE) as error:
        raise DataError(
            f"{source}: {name} of the calibration is damaged: {error}",
            possible=COPY,
            hint=AGAIN,
        ) from error
    try:
        return Calibration.from_attrs(attributes, quantities)
    except DataError as error:
        # the model does not know where it came from
        raise DataError(f"{source}: {error.message}", possible=COPY, hint=AGAIN) from error


def _read(group: zarr.Group, name: str) -> Any:
    return np.asarray(child_array(group, name)[...], np.float64)


def _deliver(delivery: Delivery, place: Path | str, calibration: Calibration) -> None:
    try:
        with refused(place, "written"):
            _write(delivery.partial, calibration)
        delivery.deliver()
    finally:
        delivery.clear()


def _write(directory: Path, calibration: Calibration) -> None:
    group = zarr.create_group(directory, zarr_format=3)
    names = []
    for name, measured in calibration.quantities.items():
        quantity = QUANTITIES[name]
        for key, values, prefix in (
            (name, measured.value, ""),
            (name + UNCERTAINTY, measured.uncertainty, "standard uncertainty of: "),
        ):
            array = group.create_array(
                key,
                shape=values.shape,
                dtype="float64",
                # A chunk that is lost later reads as NaN, which is refused, and not as zeros.
                fill_value=np.nan,
                # zstd does not notice every flipped bit
                compressors=(ZstdCodec(), Crc32cCodec()),
                dimension_names=quantity.dimensions,
                attributes={"units": quantity.unit, "long_name": prefix + quantity.meaning},
            )
            array[...] = values
            names.append(key)
    if not names and not calibration.steps:
        raise UsageError("a calibration without a step cannot be written", possible="one step at least")
    # the arrays' documents inside the group's (consolidated metadata): readers at a URL need only this one
    nodes = {name: json.loads((directory / name / ROOT).read_bytes()) for name in names}
    (directory / ROOT).write_bytes(to_json(group_document(calibration.facts(), nodes)))
