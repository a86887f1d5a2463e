"""Thousands of holds, which the root lists, on a disk that fills."""

from __future__ import annotations

import contextlib
import json
import subprocess

import pytest
from store_helpers import fill, make_spec

from acquire.errors import DataError
from acquire.store import RecordingWriter, Retention, RunCondition, hold, open_recording
from acquire.store.holds import HOLDS
from acquire.store.retention import LONGEST_WHY


@pytest.mark.needs_mount
def test_however_many_holds_there_are_the_end_finds_room_on_a_full_disk(tmp_path):
    """The root, which lists them, had outgrown what is reserved for the end."""
    place = tmp_path / "disk"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "none", str(place)], check=True)
    path, count, reason = place / "r.zarr", 10_000, "x" * LONGEST_WHY
    spec = make_spec(reserve_bytes=0, retention=Retention(max_bytes=10**9))
    try:
        with RecordingWriter.create(path, spec) as writer:
            fill(writer, 150)
            hold(path, 1000, 1, "the first")
            for lines in range(2, count + 1):
                text = json.dumps({"first_line": 1000, "count": lines, "why": reason})
                (path / "a" / "lines" / HOLDS / f"1000-{lines}.json").write_text(text)
            writer.commit()
            with contextlib.suppress(OSError), (place / "rest").open("wb", buffering=0) as rest:
                while rest.write(bytes(4096)):
                    pass
            writer.add_event("mark", 0, 1000, "so that there is something to commit")
            with pytest.raises(DataError, match="No space left on device"):
                writer.commit()
            writer.seal(RunCondition.ABORTED, "disk full", {})
        found = open_recording(path)
        assert found.state == "sealed"
        assert sum(why == reason for *_, why in found.attrs["holds"]) == count - 1
    finally:
        subprocess.run(["umount", str(place)], check=True)
