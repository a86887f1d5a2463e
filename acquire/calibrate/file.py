"""A calibration on disk: a Zarr v3 group whose arrays open in zarr-python and xarray without this program.

::

    NAME.zarr/   attributes: format, instrument, orientation, alignment, steps (how and when each was done)
      gain       (arm, column) float64, with ``units`` and ``long_name``; likewise every measured quantity
      gain_uncertainty
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.errors import GroupNotFoundError

from acquire.calibrate.calibration import FORMAT, QUANTITIES, Calibration, Measured
from acquire.errors import DataError, PlaceError, UsageError
from acquire.store.camera_stream import child_array
from acquire.store.delivery import check_new_file, check_new_place, delivery_to
from acquire.store.layout import DAMAGE, group_document, to_json
from acquire.store.opening import read_root
from acquire.store.refusals import refused
from acquire.store.remote import is_url
from acquire.store.source import source_of

if TYPE_CHECKING:
    from acquire.store.delivery import Delivery

UNCERTAINTY = "_uncertainty"
ROOT = "zarr.json"
HINT = "the path of a calibration (a directory NAME.zarr), as `acquire calibrate dark … --out` writes it"

COPY = "the copy that a recording carries, as acquire calibrate show RECORDING shows it"
AGAIN = "another copy of the calibration, or measure it again"


def save_calibration(place: Path | str, calibration: Calibration) -> None:
    """Write a calibration. An existing one is replaced as a whole; anything else is refused.

    Raises UsageError if it cannot be written, StoreError if the disk refuses.
    """
    if is_url(place) or not os.path.lexists(place):
        _deliver(delivery_to(place), place, calibration)
        return
    path = Path(place)
    # only a calibration is replaced: anything else raises here
    open_calibration(path)
    fresh = path.with_name(f".{path.name}.{os.getpid()}.new.zarr")
    # a killed process may have left it
    shutil.rmtree(fresh, ignore_errors=True)
    _deliver(delivery_to(fresh), fresh, calibration)
    before = path.with_name(f".{path.name}.{os.getpid()}.before")
    with refused(path, "written"):
        # the old one remains on the disk until the new one is in its place
        path.rename(before)
        fresh.rename(path)
        shutil.rmtree(before)


def check_calibration_place(place: Path | str) -> None:
    """Raise what `save_calibration` would raise, before the recordings are made and evaluated."""
    if is_url(place) or not os.path.lexists(place):
        check_new_place(place)
        return
    open_calibration(place)
    path = Path(place)
    # It is replaced from beside it, so that its directory has to be writable, too.
    check_new_file(path.with_name(f".{path.name}.{os.getpid()}.new.zarr"))


def open_calibration(place: Path | str) -> Calibration:
    """Open a calibration, here or at a URL.

    Raises PlaceError if there is none, DataError if it is damaged, StoreError if the store cannot be read.
    """
    source = source_of(place)
    with refused(source, "read"):
        there = source.exists()
    if not there:
        raise PlaceError(f"{source} does not exist", hint=HINT)
    try:
        attributes = read_root(source)["attributes"]
    except PlaceError as error:
        raise PlaceError(f"{source} is not a calibration: it holds no zarr.json", hint=HINT) from error
    if attributes.get("format") != FORMAT:
        raise PlaceError(
            f"{source} is not a calibration: format {attributes.get('format')!r}",
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
