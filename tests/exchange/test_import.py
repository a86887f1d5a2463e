"""``acquire import``: lines stored by other programs become the original recording."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from acquire.codes import mix_seed
from acquire.config import load_rig, load_scene
from acquire.errors import UsageError
from acquire.exchange import Layout, importing, open_lines
from acquire.lines import ARMS, LineFlag
from acquire.recon import reconstruct
from acquire.simulate import simulate
from acquire.store import Recording, open_recording, verify
from acquire.store.compare import compare

STAGES, SUBSTEPS, LINES = 8, 2, 150
CODE = f"prbs:64:{mix_seed(1, 64):#x}"
SIZES = ("--stages", STAGES, "--substeps", SUBSTEPS, "--line-rate", 50_000, "--code", CODE)
Cli = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("original") / "run.zarr"
    rig = load_rig("rig-demo", {"geometry.stages": STAGES, "geometry.substeps": SUBSTEPS})
    simulate(rig, load_scene("scene-leds"), path, LINES)
    return open_recording(path)


@pytest.fixture(scope="module")
def lines(original: Recording) -> dict[str, np.ndarray[Any, Any]]:
    return {arm: original.camera(arm).lines[:] for arm in ARMS}


def as_npy(directory: Path, lines: dict[str, Any]) -> list[Any]:
    for arm in ARMS:
        np.save(directory / f"{arm}.npy", lines[arm])
    return [directory / "a.npy", directory / "b.npy"]


def as_tiff_pages(directory: Path, lines: dict[str, Any]) -> list[Any]:
    """Pages of 30 lines, packed, as a frame grabber's program writes them."""
    for arm in ARMS:
        pages = lines[arm].reshape(5, 30, STAGES)
        tifffile.imwrite(directory / f"{arm}.tif", pages, compression="zlib", photometric="minisblack")
    return [directory / "a.tif", directory / "b.tif"]


def as_imagej(directory: Path, lines: dict[str, Any]) -> list[Any]:
    both = np.stack([lines[arm] for arm in ARMS])
    tifffile.imwrite(directory / "both.tif", both, imagej=True, metadata={"axes": "CYX"})
    return [directory / "both.tif"]


def as_hdf5(directory: Path, lines: dict[str, Any]) -> list[Any]:
    with h5py.File(directory / "both.h5", "w") as file:
        file["camera/lines"] = np.stack([lines[arm] for arm in ARMS])
        file["camera/dark"] = np.zeros((3, STAGES), np.uint16)
    return [directory / "both.h5", "--dataset", "/camera/lines"]


def as_raw(directory: Path, lines: dict[str, Any]) -> list[Any]:
    for arm in ARMS:
        (directory / f"{arm}.raw").write_bytes(b"HEAD" + lines[arm].astype(">u2").tobytes())
    words = ("--dtype", ">u2", "--pixels", STAGES, "--skip-bytes", 4)
    return [directory / "a.raw", directory / "b.raw", *words]


def as_columns(directory: Path, lines: dict[str, Any]) -> list[Any]:
    """Both arms on one sensor, surrounded by dark pixels."""
    dark = np.zeros((LINES, 3), np.uint16)
    np.save(directory / "wide.npy", np.hstack([dark, lines["a"], dark, lines["b"]]))
    words = ("--columns-a", f"3:{3 + STAGES}", "--columns-b", f"{6 + STAGES}:{6 + 2 * STAGES}")
    return [directory / "wide.npy", *words]


@pytest.mark.parametrize("write", [as_npy, as_tiff_pages, as_imagej, as_hdf5, as_raw, as_columns])
def test_imported_lines_equal_the_original_recording(
    cli: Cli, original: Recording, lines: Any, tmp_path: Path, write: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(importing, "BLOCK_LINES", 37)
    cameras = ("--white", 4095, "--black", 0, "--responsivity", 6)
    words = (*write(tmp_path, lines), *SIZES, *cameras, "--out", tmp_path / "again.zarr")
    code, said, err = cli("import", *words, "--start", "2026-01-31T12:00:00")
    assert code == 0, err
    assert f"{LINES} lines of arms a and b" in said
    imported = open_recording(tmp_path / "again.zarr")
    assert verify(tmp_path / "again.zarr").intact
    differing = [one.array for one in compare(original, imported)]
    assert sorted(differing) == ["a/flags", "a/tick", "b/flags", "b/tick"]  # no tags, and another clock
    flags = imported.camera("a").flags[:] & ~np.uint16(LineFlag.SATURATED)
    assert set(flags.tolist()) == {int(LineFlag.TIME_ESTIMATED | LineFlag.CODE_UNVERIFIED)}
    one, two = original.cut(0, LINES), imported.cut(0, LINES)
    for name in ("lines", "mask", "code"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    np.testing.assert_array_equal(np.diff(one.time_ns), np.diff(two.time_ns))
    assert (two.black_level_dn, two.responsivity_dn, two.substep_ns) == (0.0, 6.0, one.substep_ns)
    assert np.datetime64(int(two.time_ns[0]), "ns") == np.datetime64("2026-01-31T12:00:00")


def test_a_rig_file_suffices_and_the_video_is_the_same(
    cli: Cli, original: Recording, lines: Any, tmp_path: Path
) -> None:
    rig = tmp_path / "rig.toml"
    text = (Path(__file__).parents[2] / "configs" / "rig-demo.toml").read_text(encoding="utf-8")
    rig.write_text(text.replace("stages = 64", f"stages = {STAGES}").replace("substeps = 3", "substeps = 2"))
    files = as_npy(tmp_path, lines)
    assert cli("import", *files, "--config", rig, "--out", tmp_path / "again.zarr")[0] == 0
    imported = open_recording(tmp_path / "again.zarr")
    assert imported.attrs["config"]["name"] == "demo"
    assert [one.array for one in compare(original, imported)] == ["a/flags", "b/flags"]
    videos = [reconstruct(each.cut(0, LINES), 2, 2, preset="fast").video for each in (original, imported)]
    np.testing.assert_array_equal(*videos)


def test_unknown_properties_are_listed(cli: Cli, lines: Any, tmp_path: Path) -> None:
    files = as_npy(tmp_path, lines)
    code, out, err = cli("import", files[1], *SIZES, "--arm", "b", "--out", tmp_path / "b.zarr")
    assert (code, "150 lines of arm b" in out) == (0, True)
    for word in ("tags", "UTC", "saturated", "black level", "responsivity", "arm a: all its lines are"):
        assert word in err
    facts = json.loads(cli("info", tmp_path / "b.zarr", "--json")[1])
    assert facts["run_condition"] == "INCOMPLETE"
    assert facts["gap_list"] == [{"arm": "a", "first_line": 0, "count": LINES, "cause": "not_imported"}]
    assert len(facts["imported"]["unknown"]) == 7
    shown = cli("info", tmp_path / "b.zarr")[1]
    assert "UTC unknown" in shown
    assert f"from {files[1]}; not known: the trigger's tags" in " ".join(shown.split())
    assert verify(tmp_path / "b.zarr").intact
    segment = open_recording(tmp_path / "b.zarr").cut(0, LINES)
    assert [bool(arm.any()) for arm in segment.mask] == [False, True]


@pytest.mark.parametrize("form", ["hex", "text", "npy"])
def test_a_list_of_bits_is_accepted_as_a_code(
    cli: Cli, original: Recording, lines: Any, tmp_path: Path, form: str
) -> None:
    bits = original.cut(0, LINES).code
    if form == "hex":
        said = f"bits:0x{np.packbits(bits).tobytes().hex()}"
    elif form == "text":
        rows = ["".join(map(str, row)) for row in np.split(bits, [9, 99])]
        (tmp_path / "code.txt").write_text("\n".join(rows))
        said = f"bits:{tmp_path / 'code.txt'}"
    else:
        np.save(tmp_path / "code.npy", np.concatenate([[1, 1, 0], bits]))
        said = f"bits:{tmp_path / 'code.npy'}"
    start = ("--code-start", 3) if form == "npy" else ()
    sizes = (*SIZES[:-1], said, *start)
    assert cli("import", *as_npy(tmp_path, lines), *sizes, "--out", tmp_path / "again.zarr")[0] == 0
    imported = open_recording(tmp_path / "again.zarr")
    assert imported.attrs["code"]["kind"] == "bits"
    np.testing.assert_array_equal(imported.cut(0, LINES).code, bits)
    assert verify(tmp_path / "again.zarr").intact
    assert len(max(cli("info", tmp_path / "again.zarr")[1].splitlines(), key=len)) < 800


def test_lines_from_the_middle_of_a_run_have_its_code(
    cli: Cli, original: Recording, lines: Any, tmp_path: Path
) -> None:
    """By the number of the first line, or by its first code bit."""
    middle = {arm: lines[arm][40:] for arm in ARMS}
    files = as_npy(tmp_path, middle)
    assert cli("import", *files, *SIZES, "--first-line", 40, "--out", tmp_path / "n.zarr")[0] == 0
    assert cli("import", *files, *SIZES, "--code-start", 80, "--out", tmp_path / "s.zarr")[0] == 0
    expected = original.cut(40, 60)
    for name, first in (("n", 40), ("s", 0)):
        found = open_recording(tmp_path / f"{name}.zarr").cut(first, 60)
        np.testing.assert_array_equal(found.code, expected.code)
        np.testing.assert_array_equal(found.lines, expected.lines)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("sizes", [[60, 60, 30], [75, 75], [1] * 5])
def test_lines_in_several_images_of_a_tiff_file_are_refused(
    tmp_path: Path, compression: str | None, sizes: list[int]
) -> None:
    """Only the first image would be imported, and the other lines lost without a word."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for size in sizes:
            file.write(np.ones((size, STAGES), np.uint16), compression=compression, contiguous=False)
    with (
        pytest.raises(UsageError, match=f"{len(sizes)} images of lines, .* {sizes[0]} x {STAGES}, "),
        open_lines(tmp_path / "a.tif", Layout()),
    ):
        pass


def test_a_thumbnail_beside_the_lines_of_a_tiff_file_does_no_harm(tmp_path: Path) -> None:
    lines = np.arange(30 * STAGES, dtype=np.uint16).reshape(30, STAGES)
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(lines)
        file.write(lines[:4, :4].astype(np.uint8))
    with open_lines(tmp_path / "a.tif", Layout()) as opened:
        np.testing.assert_array_equal(opened.rows(None, 0, 30), lines)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["short.npy", "b.npy", *SIZES], "--lines 149, to take this number of each"),
        (["a.npy", "b.npy", *SIZES, "--stages", 9], "lines of arm a have 8 pixels, with 9 stages"),
        (["a.npy", "b.npy", *SIZES[:-1], "bits:0xff00"], "the code has 16 bits, but 150 lines need 315"),
        (["a.npy", "b.npy", *SIZES[:-1], "prbs:64"], "possible: prbs:DEGREE:SEED"),
        (["a.npy", "b.npy", *SIZES[:-1], "bits:a.npy"], "does not hold bits"),
        (["a.npy", "b.npy", *SIZES[:4]], "cannot be imported without --line-rate, --code"),
        (["a.npy", *SIZES, "--line-rate", 0], "--line-rate 0 is out of range"),
        (["a.npy", *SIZES, "--substeps", 9], "--substeps 9 is out of range"),
        (["a.npy", *SIZES, "--lines", 999], "possible: 1 to 150"),
        (["a.npy", *SIZES, "--arm", "c"], "possible: a, b"),
        (["a.npy", *SIZES, "--start", "noon"], "2026-01-31T12:00:00"),
        (["a.npy", *SIZES, "--columns-a", "0-8"], "FIRST:END"),
        (["a.npy", *SIZES, "--columns-a", "0:9"], "0:8 or a part of it"),
        (["float.npy", *SIZES], "float.npy holds float64"),
        (["flat.npy", *SIZES], "has the shape 150"),
        (["three.npy", *SIZES], "(arm, line, pixel) with two arms"),
        (["text.npy", *SIZES], "cannot be read as NumPy"),
        (["text.h5", *SIZES], "cannot be read as HDF5"),
        (["text.tif", *SIZES], "cannot be read as TIFF"),
        (["several.h5", *SIZES], "--dataset PATH"),
        (["several.h5", *SIZES, "--dataset", "/c"], "possible: /a, /b"),
        (["a.raw", *SIZES], "--dtype and --pixels"),
        (["a.raw", *SIZES, "--dtype", "u16", "--pixels", 7], "are not a whole number of lines"),
        (["a.raw", *SIZES, "--dtype", "f4", "--pixels", 8], "possible: uint8"),
        (["a.xyz", *SIZES], "cannot be taken from its name"),
        (["absent.npy", *SIZES], "No such file"),
        (["pipe.npy", *SIZES], "it is a pipe"),
        (["pipe.raw", *SIZES, "--dtype", "u16", "--pixels", 8], "it is a pipe"),
        (["a.npy", *SIZES[:-1], "bits:pipe.npy"], "it is a pipe"),
        (["a.npy", *SIZES[:-1], "bits:pipe.raw"], "it is a pipe"),
        (["archive.npy", *SIZES], "an archive of several arrays"),
        (["a.npy", "b.npy", "a.npy", *SIZES], "3 files of lines"),
        (["a.npy", "--config", "rig-demo", "--stages", 0], "--stages 0 is out of range"),
        (["a.npy", "--config", "rig-demo", "--substeps", 0], "--substeps 0 is out of range"),
        (["a.npy", "--config", "rig-demo", "--line-rate", 0], "--line-rate 0 is out of range"),
        (["a.npy", *SIZES, "--white", -1], "--white -1 is out of range"),
        (["a.npy", *SIZES, "--white", "nan"], "--white nan is out of range"),
        (["a.npy", *SIZES, "--responsivity", 0], "--responsivity 0 is out of range"),
        (["a.npy", *SIZES, "--black", 300, "--white", 255], "300 DN, is not below white, 255 DN"),
        (["a.npy", "b.npy", *SIZES, "--arm", "b"], "--arm b: both arms were given"),
        (["both.npy", *SIZES, "--arm", "b"], "both.npy has two arms"),
        (["a.npy", *SIZES, "--columns-b", "0:8"], "or --arm b"),
        (["a.raw", *SIZES, "--dtype", "u16", "--pixels", 8, "--skip-bytes", -16], "0 or more"),
        (
            ["a.raw", *SIZES, "--dtype", "u16", "--pixels", 8, "--skip-bytes", 10**6],
            "cannot be skipped: a.raw has",
        ),
        (["a.npy", *SIZES, "--start", "0001-01-01"], "1970 to 2099"),
        (["a.npy", *SIZES, "--start", "2300-01-01"], "1970 to 2099"),
        (["a.npy", *SIZES, "--first-line", 10**20], "possible: up to line "),
        (["a.npy", *SIZES, "--first-line", 10**15], "possible: up to line "),
    ],
)
def test_inconsistent_input_is_refused_and_nothing_is_written(
    cli: Cli, lines: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[Any], said: str
) -> None:
    as_npy(tmp_path, lines)
    for name, array in (
        ("short", lines["a"][:-1]), ("float", lines["a"].astype(float)), ("flat", lines["a"][:, 0]),
        ("three", np.stack([lines["a"]] * 3)), ("both", np.stack([lines["a"]] * 2)),
    ):  # fmt: skip
        np.save(tmp_path / f"{name}.npy", array)
    for suffix in ("npy", "h5", "tif"):
        (tmp_path / f"text.{suffix}").write_text("no lines\n")
    with h5py.File(tmp_path / "several.h5", "w") as file:
        file["a"], file["b"] = lines["a"], lines["b"]
    for name in ("pipe.npy", "pipe.raw"):
        os.mkfifo(tmp_path / name)
    with (tmp_path / "archive.npy").open("wb") as archive:
        np.savez(archive, a=lines["a"])
    for name in ("a.raw", "a.xyz"):
        (tmp_path / name).write_bytes(lines["a"].tobytes())
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    code, _, err = cli("import", *words, "--out", "again.zarr")
    assert (code, said in err) == (2, True), err
    assert sorted(tmp_path.iterdir()) == before


def test_a_file_that_was_cut_short_leaves_nothing(
    cli: Cli, lines: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it is being read: its size was right at first."""
    files = as_npy(tmp_path, lines)
    checked = importing._check_span

    def shrink(*words: Any) -> None:
        checked(*words)
        with files[1].open("r+b") as file:
            file.truncate(1000)

    monkeypatch.setattr(importing, "_check_span", shrink)
    code, _, err = cli("import", *files, *SIZES, "--out", tmp_path / "again.zarr")
    assert (code, "it was cut short" in err) == (6, True), err
    assert sorted(tmp_path.iterdir()) == sorted(files)


def test_an_export_can_be_imported_again_unchanged(cli: Cli, original: Recording, tmp_path: Path) -> None:
    source = str(original.source)
    for name in ("lines.h5", "lines.tif", "lines.npy"):
        out = tmp_path / f"{name}.zarr"
        assert cli("export", source, tmp_path / name)[0] == 0
        assert cli("import", tmp_path / name, *SIZES, "--out", out)[0] == 0
        np.testing.assert_array_equal(open_recording(out).cut(0, LINES).lines, original.cut(0, LINES).lines)


def test_nothing_is_overwritten(cli: Cli, lines: Any, tmp_path: Path) -> None:
    files = as_npy(tmp_path, lines)
    (tmp_path / "again.zarr").mkdir()
    code, _, err = cli("import", *files, *SIZES, "--out", tmp_path / "again.zarr")
    assert (code, "exists already" in err) == (2, True)
    assert not list((tmp_path / "again.zarr").iterdir())
