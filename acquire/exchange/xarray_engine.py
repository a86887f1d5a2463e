"""``xarray.open_dataset(PLACE, engine="acquire")``: videos and recordings with all their coordinates.

Only xarray imports this module, through its entry point. Compared with xarray's own Zarr engine it adds
``line`` as a coordinate, which takes no memory however many lines there are, and opens a video with its
coordinates without an argument for consolidated metadata.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pandas as pd
import xarray
from xarray.backends import BackendEntrypoint

from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.store import format_of, open_recording, open_video
from acquire.store.source import source_of

if TYPE_CHECKING:
    from collections.abc import Iterable


IMAGE = "video"
"""Name of a video's image in the dataset; in the file it is level 0."""


class AcquireBackend(BackendEntrypoint):
    """Opens lazily: only metadata and the time stamps of a video are read."""

    description = "acquire recordings and videos, with their coordinates"
    open_dataset_parameters = ("filename_or_obj", "drop_variables", "group")

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        group: str | None = None,
    ) -> xarray.Dataset:
        """Open a video, or an arm of a recording (``group``, default "a"). Raises as `open_recording`."""
        place = str(filename_or_obj)
        dataset: xarray.Dataset
        if (format_of(place) or "").startswith("acquire-video/"):
            if group is not None:
                raise UsageError(f"{place} has no group {group!r}", possible="none: a video has no groups")
            levels = open_video(place).attrs["ome"]["multiscales"][0]["datasets"]
            # viewers' smaller copies of the image have other axes, which a dataset cannot hold under one name
            smaller = [str(level["path"]) for level in levels[1:]]
            store = source_of(place).zarr_store()
            # With chunks=None xarray reads lazily without dask, which may not be installed.
            dataset = xarray.open_zarr(store, consolidated=False, chunks=None, drop_variables=smaller)
            dataset = dataset.rename({"0": IMAGE})
        else:
            recording, arm = open_recording(place), ARMS[0] if group is None else group
            if arm not in ARMS:
                raise UsageError(f"{recording} has no group {arm!r}", possible=", ".join(ARMS))
            store = recording.source.zarr_store()
            dataset = xarray.open_zarr(store, group=arm, consolidated=True, chunks=None)
            first = recording.first_line
            dataset = dataset.assign_coords(line=pd.RangeIndex(first, first + dataset.sizes["line"]))
        names = [drop_variables] if isinstance(drop_variables, str) else [*(drop_variables or ())]
        return dataset.drop_vars(names)

    def guess_can_open(self, _: Any) -> bool:
        """Return False: the engine is used only by name and does not displace xarray's Zarr engine."""
        return False
