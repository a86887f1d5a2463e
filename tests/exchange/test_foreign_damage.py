"""Files of other programs that are cut short, damaged or packed: refused with a reason, or unpacked once."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
import tifffile

from acquire.errors import DataError, UsageError
from acquire.exchange import Layout, open_lines, parse_code

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("raw", "words"),
    [(b"", "cannot be read as NumPy"), (b"PK\x03\x04 cut short", "is an archive of several arrays")],
)
def test_a_cut_numpy_file_is_refused_as_lines_and_as_code(tmp_path: Path, raw: bytes, words: str) -> None:
    path = tmp_path / "cut.npy"
    path.write_bytes(raw)
    with pytest.raises(UsageError, match=words), open_lines(path, Layout()):
        pass
    with pytest.raises(UsageError, match=words):
        parse_code(f"bits:{path}")


@pytest.mark.parametrize(
    "values", [np.zeros(3, [("bit", "u1")]), np.ones(3, np.complex64), np.ones((2, 3)), np.uint8(1)]
)
def test_only_a_row_of_real_numbers_is_accepted_as_code_bits(tmp_path: Path, values: np.ndarray) -> None:
    path = tmp_path / "code.npy"
    np.save(path, values)
    with pytest.raises(UsageError, match="does not hold bits"):
        parse_code(f"bits:{path}")


def test_a_seed_of_thousands_of_digits_is_refused_in_words() -> None:
    """Python converts up to 4300 digits; a rig file takes a seed of up to 39."""
    with pytest.raises(UsageError, match=r"the code .* cannot be read"):
        parse_code(f"prbs:64:{'7' * 5000}")


@pytest.mark.parametrize("compression", ["zlib", "lzma"])
def test_a_damaged_page_is_an_error_of_the_lines_in_it(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "damaged.tif"
    lines = np.random.default_rng(3).integers(0, 200, (4, 64, 32), np.uint8)
    tifffile.imwrite(path, lines, compression=compression, photometric="minisblack")
    with tifffile.TiffFile(path) as file:
        place = file.pages[1].dataoffsets[0]
    with path.open("r+b") as raw:
        raw.seek(place)
        raw.write(b"\xff" * 40)
    with open_lines(path, Layout()) as found:
        np.testing.assert_array_equal(found.rows(None, 0, 64), lines[0])
        with pytest.raises(DataError, match="lines 60 to 69 cannot be read"):
            found.rows(None, 60, 70)


def test_arms_read_in_turn_unpack_each_page_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "arms.tif"
    lines = np.random.default_rng(4).integers(0, 200, (2, 64, 32), np.uint8)
    tifffile.imwrite(path, lines, compression="zlib", photometric="minisblack", metadata={"axes": "CYX"})
    unpacked = []
    whole = tifffile.TiffPage.asarray

    def counted(page: tifffile.TiffPage) -> np.ndarray:
        unpacked.append(page.index)
        return whole(page)

    monkeypatch.setattr(tifffile.TiffPage, "asarray", counted)
    with open_lines(path, Layout()) as found:
        assert found.arms == 2
        for start in range(0, 64, 16):
            for arm in (0, 1):
                part = found.rows(arm, start, start + 16)
                np.testing.assert_array_equal(part, lines[arm, start : start + 16])
    assert unpacked == [0, 1]


@pytest.mark.parametrize("arms", [(), (1,), (2,)])
def test_a_numpy_file_in_fortran_order_is_read_and_may_be_cut_short(
    tmp_path: Path, arms: tuple[int, ...]
) -> None:
    """A mapped file that shrinks, or whose disk fails, ends the process with SIGBUS."""
    path, lines = (
        tmp_path / "lines.npy",
        np.random.default_rng(5).integers(0, 200, (*arms, 3000, 8), np.uint16),
    )
    np.save(path, np.asfortranarray(lines))
    with open_lines(path, Layout()) as found:
        for arm in range(*arms) if arms else (None,):
            expected = lines if arm is None else lines[arm]
            for start, stop in ((0, 3000), (7, 8), (2990, 3000)):
                np.testing.assert_array_equal(found.rows(arm, start, stop), expected[start:stop])
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size // 2)
        with pytest.raises(DataError, match="ends before line 3000: it was cut short"):
            found.rows(0 if arms else None, 100, 3000)


CUT_SHORT = """
import os, sys
from pathlib import Path
from acquire.errors import UsageError
from acquire.exchange import code_words

kept = code_words.mapped

def mapped_and_cut(path):
    found = kept(path)
    os.truncate(path, 128)
    return found

code_words.mapped = mapped_and_cut
try:
    code_words.parse_code("bits:" + sys.argv[1])
except UsageError as error:
    print(error)
"""


def test_a_code_whose_file_is_cut_short_meanwhile_is_an_error_and_no_crash(tmp_path: Path) -> None:
    path = tmp_path / "code.npy"
    np.save(path, np.ones(20_000, np.uint8))
    done = subprocess.run(
        [sys.executable, "-c", CUT_SHORT, str(path)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done
    assert "code.npy was changed while it was read; try: again" in done.stdout


def test_a_code_is_its_own_once_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "code.npy"
    np.save(path, np.array([1, 0, 1, 1], np.uint8))
    code = parse_code(f"bits:{path}")
    path.write_bytes(b"")
    assert code.bits(0, 4).tolist() == [1, 0, 1, 1]


@pytest.mark.parametrize("compression", ["zlib", None])
def test_a_colour_picture_is_refused_as_such(tmp_path: Path, compression: str | None) -> None:
    """Without compression its pixels, of three samples each, were taken for lines of three pixels."""
    path = tmp_path / "colour.tif"
    tifffile.imwrite(path, np.zeros((64, 32, 3), np.uint8), compression=compression, photometric="rgb")
    with pytest.raises(UsageError, match="several colours") as caught, open_lines(path, Layout()):
        pass
    assert "64 x 32 x 3" in str(caught.value)


@pytest.mark.parametrize("first_page", [0, 8])
def test_a_tiff_file_without_an_image_is_refused_as_such(tmp_path: Path, first_page: int) -> None:
    """A program that was ended while it wrote leaves a header, and a page without tags or none."""
    path = tmp_path / "begun.tif"
    path.write_bytes(b"II*\0" + first_page.to_bytes(4, "little") + bytes(6))
    with pytest.raises(UsageError, match="without an image"), open_lines(path, Layout()):
        pass


def test_a_single_value_is_refused_with_a_complete_sentence(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", np.uint8(3))
    with (
        pytest.raises(UsageError, match="shape of a single value"),
        open_lines(tmp_path / "one.npy", Layout()),
    ):
        pass
