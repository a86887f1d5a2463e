"""Recordings of lines behind a fibre: the table travels with them, and tiles are cut out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from store_helpers import fill, make_spec

from acquire.errors import DataError, UsageError
from acquire.fibre import Fibre, Tile
from acquire.store import RecordingWriter, RunCondition, open_recording

FIBRE = Fibre.side_by_side(4, 2, 16, 24, 26)


def test_a_recording_behind_a_fibre_carries_its_table_and_is_cut_by_tiles(tmp_path: Path) -> None:
    sizes = {"stages": 4, "substeps": 2, "pixels": 26}
    spec = make_spec(**sizes, layout="fibre", fibre=FIBRE)
    with RecordingWriter.create(tmp_path / "r.zarr", spec) as writer:
        fill(writer, 90)
        writer.seal(RunCondition.GOOD, "end", {})
    found = open_recording(tmp_path / "r.zarr")
    assert found.attrs["geometry"] == {**sizes, "fibre": FIBRE.to_attrs()}
    assert found.fibre == FIBRE
    for tile in FIBRE.tiles:
        segment = found.cut(found.first_line + 20, 30, tile)
        for arm, columns, lines in zip("ab", FIBRE.pixels(tile), segment.lines, strict=True):
            np.testing.assert_array_equal(lines, found.camera(arm).read("lines", 20, 50)[:, columns])
        assert segment.first_column == tuple(columns.start for columns in FIBRE.pixels(tile))
    with pytest.raises(UsageError, match="shows 6 tiles of a scene behind a fibre; none was named"):
        found.cut(found.first_line, 10)
    plain = make_spec()
    with RecordingWriter.create(tmp_path / "plain.zarr", plain) as writer:
        fill(writer, 50)
        writer.seal(RunCondition.GOOD, "end", {})
    with pytest.raises(UsageError, match="has no tile 0,0: its lines see one scene"):
        open_recording(tmp_path / "plain.zarr").cut(plain.first_line, 10, Tile(0, 0))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"layout": "fibre"}, "layout 'fibre' does not go with no fibre"),
        (
            {"fibre": FIBRE, "stages": 4, "substeps": 2, "pixels": 26},
            "does not go with a fibre",
        ),
        (
            {"fibre": FIBRE, "layout": "fibre", "stages": 4, "substeps": 2, "pixels": 30},
            "30 pixels has a fibre of",
        ),
    ],
)
def test_a_table_that_contradicts_the_recording_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make_spec(**changes)


def test_a_damaged_table_is_refused_when_the_recording_is_cut(tmp_path: Path) -> None:
    spec = make_spec(stages=4, substeps=2, pixels=26, layout="fibre", fibre=FIBRE)
    with RecordingWriter.create(tmp_path / "r.zarr", spec) as writer:
        fill(writer, 50)
        writer.seal(RunCondition.GOOD, "end", {})
    root = tmp_path / "r.zarr" / "zarr.json"
    document = json.loads(root.read_text())
    document["attributes"]["geometry"]["fibre"]["bands"]["a"] = [0, 3]
    root.write_text(json.dumps(document))
    with pytest.raises(DataError, match="overlap or do not fit"):
        open_recording(tmp_path / "r.zarr").cut(spec.first_line, 10, Tile(0, 0))
    document["attributes"]["geometry"]["fibre"]["bands"]["a"] = [-1, 3]
    root.write_text(json.dumps(document))
    with pytest.raises(DataError, match=r"geometry\.fibre\.bands\.a\.0"):
        open_recording(tmp_path / "r.zarr")
