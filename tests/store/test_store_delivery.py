"""Videos that are written to URLs: whole or not at all, and nothing of others is replaced."""

from __future__ import annotations

import uuid
from pathlib import Path

import numpy as np
import pytest

from acquire.errors import PlaceError, StoreError, UsageError
from acquire.store import open_video, write_video
from acquire.store.delivery import check_new_place
from acquire.store.remote import RemoteSource

VIDEO = np.arange(5 * 4 * 4, dtype=np.float32).reshape(5, 4, 4)
TIME_NS = np.arange(5, dtype=np.int64) * 1000


pytestmark = pytest.mark.usefixtures("bucket")


@pytest.fixture(params=["s3", "memory", "file"])
def place(request, bucket, tmp_path):
    where = {"s3": bucket, "memory": "memory:/", "file": f"file://{tmp_path}"}[request.param]
    return f"{where}/{uuid.uuid4()}/video.zarr"


def write(place):
    write_video(
        place, VIDEO, TIME_NS, pixel_size=3.0, frame_interval_ns=1000.0, provenance={"solver": "admm"}
    )


def test_a_video_is_the_same_far_away(place):
    write(place)
    there = open_video(place)
    np.testing.assert_array_equal(there.video[:], VIDEO)
    np.testing.assert_array_equal(there.time_ns, TIME_NS)
    assert there.attrs["provenance"] == {"solver": "admm"}
    assert there.attrs["ome"]["multiscales"][0]["name"] == "video"


def test_nothing_is_replaced(place):
    write(place)
    with pytest.raises(UsageError, match="exists already"):
        write(place)


def test_what_is_not_a_video_is_left_alone(place):
    target = RemoteSource(place)
    if target.has_directories:
        target.make_directory_of("notes/today.txt")
    target.put("notes/today.txt", b"do not lose me")
    with pytest.raises(UsageError, match=r"holds something else, such as notes/today\.txt"):
        check_new_place(place)


@pytest.mark.parametrize("fatal", [2, 4, 5])
def test_a_reader_sees_no_part_of_an_upload_that_failed_and_it_can_be_tried_again(place, fatal, monkeypatch):
    put = RemoteSource.put_file
    keys = []

    def fails(self, key, file):
        keys.append(key)
        if len(keys) == fatal:
            raise OSError("the line is dead")
        put(self, key, file)

    with monkeypatch.context() as patch:
        patch.setattr(RemoteSource, "put_file", fails)
        with pytest.raises(StoreError, match="the line is dead"):
            write(place)
    assert "zarr.json" not in RemoteSource(place).sizes()
    with pytest.raises(PlaceError):
        open_video(place)
    write(place)
    np.testing.assert_array_equal(open_video(place).video[:], VIDEO)


def test_the_root_is_put_last_and_nothing_stays_here(place, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    keys, put = [], RemoteSource.put_file

    def noted(self, key, file):
        keys.append(key)
        put(self, key, file)

    monkeypatch.setattr(RemoteSource, "put_file", noted)
    write(place)
    assert keys[-1] == "zarr.json"
    assert keys.count("zarr.json") == 1
    assert not list(Path(tmp_path).glob("acquire-*"))


def test_a_store_that_does_not_answer_is_refused_before_anything_is_solved(bucket):
    with pytest.raises(PlaceError, match="nobucketofthisname"):
        check_new_place("s3://nobucketofthisname/x.zarr")
    with pytest.raises(UsageError, match="gopher"):
        check_new_place("gopher://x/y.zarr")
    with pytest.raises(PlaceError, match="does not exist"):
        open_video(f"{bucket}/no.zarr")
