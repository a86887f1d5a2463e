"""What a disk refuses is refused with advice that fits: a repeated command does not make a disk writable."""

from __future__ import annotations

import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from store_helpers import fill, make_spec
from typer.testing import CliRunner

from acquire.cli import app
from acquire.errors import AcquireError, PlaceError, StoreError
from acquire.store import RecordingWriter, RunCondition
from acquire.store.refusals import refusal

READ_ONLY = "try: another disk, or mount this one for writing"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    with RecordingWriter.create(tmp_path / "r.zarr", make_spec()) as writer:
        fill(writer, 150)
        writer.seal(RunCondition.GOOD, "done", {})
    return tmp_path / "r.zarr"


@pytest.fixture(params=["size=1m,ro", "size=64k"])
def disk(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[tuple[Path, bool]]:
    """A disk that takes no recording, and whether it is read-only; otherwise it is full at once."""
    place = tmp_path / "disk"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", request.param, "none", place], check=True)
    yield place, request.param.endswith("ro")
    subprocess.run(["umount", place], check=True)


def refused(*words: object) -> tuple[int, str]:
    """Exit code and text of the error with which a command ends."""
    error = CliRunner().invoke(app, [str(word) for word in words]).exception
    assert isinstance(error, AcquireError), error
    return error.exit_code, str(error)


@pytest.mark.needs_mount
def test_the_advice_of_an_upload_fits_the_disk(recording: Path, disk: tuple[Path, bool]) -> None:
    """On a read-only disk it was only to repeat the command."""
    place, read_only = disk
    code, said = refused("upload", recording, f"file://{place}/r.zarr")
    if read_only:
        assert (code, READ_ONLY in said) == (2, True), said
    else:
        assert (code, "try: free space there, or another disk" in said) == (5, True), said
    assert said.endswith("then repeat the command, which continues with what is there already")


@pytest.mark.needs_mount
@pytest.mark.parametrize(
    "words",
    [
        ("cut", "--first-line", 1000, "--lines", 150, "--out", "cut.npz"),
        ("export", "lines.npz"),
        ("reconstruct", "--out", "video.zarr"),
    ],
)
def test_the_advice_for_a_new_file_fits_the_disk(
    recording: Path, disk: tuple[Path, bool], words: tuple[object, ...]
) -> None:
    place, read_only = disk
    if not read_only:
        (place / "rest").write_bytes(bytes(60_000))
    command, *options, name = words
    code, said = refused(command, recording, *options, place / str(name))
    if read_only:
        assert (code, "is on a disk that is mounted read-only" in said) == (2, True), said
        assert "try: a directory on another disk, or mount this one for writing" in said
    elif command != "reconstruct":  # which would first solve
        assert (code, "try: free space there, or another disk" in said) == (5, True), said
        assert [path.name for path in place.iterdir()] == ["rest"]


@pytest.mark.parametrize(
    ("number", "kind", "advice"),
    [
        (errno.EROFS, PlaceError, READ_ONLY),
        (errno.EACCES, PlaceError, "try: its permissions for this user"),
        (errno.EPERM, PlaceError, "try: its permissions for this user"),
        (errno.ENAMETOOLONG, PlaceError, "try: a shorter name"),
        (errno.ENOTDIR, PlaceError, "try: another path"),
        (errno.ENOSPC, StoreError, "try: free space there"),
        (errno.EDQUOT, StoreError, "try: free space within this user's quota there"),
        (errno.EFBIG, StoreError, "try: a disk whose file system holds larger files"),
        (errno.EIO, StoreError, "try: the kernel's log"),
    ],
)
@pytest.mark.parametrize("place", ["/data/r.zarr", "file:///data/r.zarr"])
def test_every_error_of_a_disk_has_its_own_advice(
    place: str, number: int, kind: type[Exception], advice: str
) -> None:
    found = refusal(place, OSError(number, os.strerror(number)), "written", "then repeat the command")
    assert type(found) is kind
    assert advice in str(found)
    assert str(found).endswith("; then repeat the command")
