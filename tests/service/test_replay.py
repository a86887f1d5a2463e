"""``acquire replay``: through trigger, cameras, ring, recorder and disk, and the lines are the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from live_daemon import Daemon, acquire

from acquire.daemon.states import SEALED
from acquire.store import open_recording


def test_a_daemons_recording_is_replayed_and_recorded_again_identically(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    try:
        with daemon.client() as client:
            client.arm()
            client.start(tmp_path / "first.zarr", lines=2500)
            client.wait(SEALED, 30)
    finally:
        daemon.close()
    first = open_recording(tmp_path / "first.zarr")
    assert first.first_line > 0
    again = acquire(
        "replay", tmp_path / "first.zarr", "--out", tmp_path / "again.zarr", "--speed", 2, "--json"
    )
    assert again.code == 0, again.err
    assert again.json["identical"] is True
    replayed = open_recording(tmp_path / "again.zarr")
    assert (replayed.lines, replayed.first_line, replayed.attrs["run_condition"]) == (2500, 0, "GOOD")
    old, new = first.cut(first.first_line + 100, 300), replayed.cut(100, 300)
    np.testing.assert_array_equal(old.lines, new.lines)
    np.testing.assert_array_equal(old.code, new.code)
    assert replayed.attrs["replayed"]["run_id"] == first.attrs["run_id"]
    for words, reason in ((("--loop",), "never end"), (("--speed", "-1"), "speed -1")):
        refused = acquire("replay", tmp_path / "first.zarr", "--out", tmp_path / "none.zarr", *words)
        assert refused.code == 2
        assert reason in refused.err
        assert not (tmp_path / "none.zarr").exists()
