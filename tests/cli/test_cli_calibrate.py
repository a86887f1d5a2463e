"""``acquire calibrate`` as a user types it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments import COLUMNS, NOISE, dots, record, white
from PIL import Image

from acquire.calibrate import Measured, open_calibration
from acquire.calibrate.calibration import Finding, Instrument
from acquire.calibrate.words import found_facts
from acquire.store import open_video

Cli = Callable[..., Any]
OFF = {"kind": "misregistration", "rows": 1.2, "columns": 0.7, "turn_deg": -0.4}
EFFECTS = (*NOISE, *COLUMNS, OFF, {"kind": "beam_splitter", "part_a": 0.47})


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    directory = tmp_path_factory.mktemp("taken")
    scenes: dict[str, Any] = {"dark": white(effects=EFFECTS), "flat": white(effects=EFFECTS)}
    scenes["target"] = dots(directory, EFFECTS)
    return {name: record(directory / f"{name}.zarr", scene, name) for name, scene in scenes.items()}


def test_step_by_step_to_a_page(cli: Cli, taken: dict[str, Path], tmp_path: Path) -> None:
    cal = tmp_path / "cal.zarr"
    steps = {"dark": "dark", "flat": "flat", "transfer": "flat", "orientation": "target", "align": "target"}
    said = {}
    for step, recording in steps.items():
        answer = cli("calibrate", step, taken[recording], "--out", cal)
        assert answer.code == 0, answer.err
        assert f"{step}, 512 lines" in answer.out
        assert f"saved in  {cal}" in answer.out
        said[step] = answer.out
    assert "uncertain by" in said["dark"]
    assert "arm A's part of the light" in said["flat"]
    assert "DN per electron" in said["transfer"]
    assert "turn 90" in said["orientation"]
    assert "+1.2" in said["align"]
    answer = cli("calibrate", "show", cal, "--out", tmp_path / "page")
    assert answer.code == 0, answer.err
    assert "cameras" in answer.out
    assert "SIM-A" in answer.out
    page = (tmp_path / "page" / "index.html").read_text()
    assert page.count("<picture>") == 2
    with Image.open(tmp_path / "page" / "columns.png") as picture:
        assert picture.width > 1000
    assert cli("calibrate", "show", cal, "--json").json["orientation"] == "turn 90"
    answer = cli("calibrate", "check", cal, taken["target"])
    assert answer.code == 0, answer.err
    assert answer.out.count("holds") == 6


def test_figures_have_the_digits_that_they_are_sure_to() -> None:
    """A linearity error was 0.00013199 % ± 0.0015."""
    instrument = Instrument(stages=4, substeps=3, substep_s=1e-5, layout="dual", cameras={"a": {}, "b": {}})
    found = {
        "linearity_error": Measured(np.array([1.3199e-6, 0.00513]), np.array([1.5e-5, 0.0])),
        "full_well_e": Measured(np.array([19122.4, 64.123456]), np.array([961.0, 0.0123])),
    }
    words = found_facts(Finding("transfer", instrument, found))
    assert words["linearity error"] == "a 0.0001 % ± 0.0015, b 0.513 % ± 0"
    assert words["full well"] == "a 19120 e ± 9.6e+02, b 64.123 e ± 0.012"


def test_a_full_well_that_a_repeated_transfer_keeps_is_said(cli: Cli, tmp_path: Path) -> None:
    """It passed for a result of the new lines: neither the answer nor `show` said of when it was."""
    effects, cal = [*NOISE, {"kind": "full_well", "capacity_e": 20_000}], tmp_path / "cal.zarr"
    levels = [record(tmp_path / f"{x}.zarr", white(x, effects), "flat") for x in (0.1, 0.2, 0.3, 0.37, 0.42)]
    dark = record(tmp_path / "dark.zarr", white(effects=effects), "dark")
    assert cli("calibrate", "dark", dark, "--out", cal).code == 0
    first = cli("calibrate", "transfer", levels[1], "--out", cal)
    assert "full well" not in first.out + cli("calibrate", "show", cal).out
    whole = cli("calibrate", "transfer", *levels, "--out", cal)
    assert "full well" in whole.out
    assert "kept" not in whole.out + cli("calibrate", "show", cal).out
    steps = open_calibration(cal).steps
    made = steps["transfer"]["made"]
    kept = f"not reached by these lines, so that of {made} is kept"
    for _ in range(2):  # the date stays that of the lines that reached it
        again = cli("calibrate", "transfer", levels[1], "--out", cal)
        assert kept in " ".join(again.out.split()), again.out
        assert kept in " ".join(cli("calibrate", "show", cal).out.split())
    found = open_calibration(cal).finding("transfer")
    assert found_facts(found)["full well"].startswith("a 19")
    assert kept in found_facts(found)["full well"]
    assert cli("calibrate", "transfer", *levels, "--out", cal).code == 0
    assert kept not in " ".join(cli("calibrate", "show", cal).out.split())


def test_a_step_is_forgotten(cli: Cli, taken: dict[str, Path], tmp_path: Path) -> None:
    """A wrong veil, or blur, stayed in the calibration for ever: a step could only be replaced."""
    cal = tmp_path / "cal.zarr"
    for step in ("dark", "flat", "transfer"):
        assert cli("calibrate", step, taken["dark" if step == "dark" else "flat"], "--out", cal).code == 0
    answer = cli("calibrate", "forget", "transfer", "--out", cal)
    assert answer.code == 0, answer.err
    assert "forgotten  transfer" in answer.out
    assert "dark, flat" in answer.out
    shown = cli("calibrate", "show", cal).out
    assert "gain" in shown
    assert "DN per electron" not in shown
    for words, why in (
        (("transfer",), "has no step 'transfer'"),
        (("dark",), "nothing would be left"),
        ((), "STEP"),
    ):
        refused = cli("calibrate", "forget", *words, "--out", cal)
        assert refused.code == 2
        assert why in refused.err
    assert cli("calibrate", "transfer", taken["flat"], "--out", cal).code == 0
    gone = cli("calibrate", "forget", "flat", "transfer", "--out", cal, "--json").json
    assert gone == {"calibration": str(cal), "forgotten": ["flat", "transfer"], "steps": ["dark"]}


def test_a_failed_check_names_what_has_changed(cli: Cli, taken: dict[str, Path], tmp_path: Path) -> None:
    cal = tmp_path / "cal.zarr"
    assert cli("calibrate", "align", taken["target"], "--out", cal, "--json").code == 0
    moved = (*NOISE, OFF | {"rows": 3.0})
    other = record(tmp_path / "other.zarr", dots(tmp_path, moved), "target")
    answer = cli("calibrate", "check", cal, other, "--json")
    assert answer.code == 1
    rows = {row["quantity"]: row for row in answer.json["compared"]}
    assert rows["rows"]["so"].startswith("changed")
    assert rows["columns"]["so"] == "holds"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("flat", "flat"), "does not exist"),
        (("dark", "flat"), "is not dark"),
        (("dark", "target"), "is not dark"),
        (("orientation", "dark"), "constant code"),
        (("align", "target", "--lines", 60), "complete lines do not determine"),
        (("dark", "dark", "--lines", 3), "too short"),
        (("dark", "dark", "--first-line", 99_999), "has no line 99999"),
    ],
)
def test_impossible_requests_are_refused_and_leave_nothing_behind(
    cli: Cli, taken: dict[str, Path], tmp_path: Path, words: Any, said: str
) -> None:
    step, recording, *more = words
    answer = cli("calibrate", step, taken[recording], "--out", tmp_path / "cal.zarr", *more)
    assert answer.code == 2
    assert said in answer.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("step", "recordings"),
    [
        ("dark", ["flat"]),
        ("transfer", ["flat", "other"]),
        ("psf", ["flat"]),
        ("delay", ["flat"]),
        ("linearity", ["flat", "other"]),
    ],
)
def test_another_instruments_recording_is_refused_before_it_is_evaluated(
    cli: Cli, taken: dict[str, Path], tmp_path: Path, step: str, recordings: list[str]
) -> None:
    """The evaluation would refuse these with an error of its own, after it has read them."""
    cal, other = tmp_path / "cal.zarr", tmp_path / "other.zarr"
    there = record(
        tmp_path / "dark.zarr", white(effects=EFFECTS), "dark", 64, **{"cameras.b.serial": "OTHER"}
    )
    assert cli("calibrate", "dark", there, "--out", cal).code == 0
    record(other, white(effects=EFFECTS), "flat", 64, **{"cameras.b.serial": "OTHER"})
    given = [other if name == "other" else taken[name] for name in reversed(recordings)]
    answer = cli("calibrate", step, *given, "--out", cal)
    assert answer.code == 2
    assert f"{taken['flat']} is of another instrument than {cal}: camera b: serial is SIM-B" in answer.err
    assert "--out with another name" in answer.err


def test_an_undetermined_orientation_is_not_saved(cli: Cli, tmp_path: Path) -> None:
    plain = record(tmp_path / "plain.zarr", white(0.4, NOISE), "target", 256)
    answer = cli("calibrate", "orientation", plain, "--out", tmp_path / "cal.zarr")
    assert answer.code == 2
    assert "is not clear" in answer.err
    assert not (tmp_path / "cal.zarr").exists()


def test_a_recording_carries_the_calibration_of_its_rig(
    cli: Cli, taken: dict[str, Path], tmp_path: Path
) -> None:
    cal = tmp_path / "cal.zarr"
    for step, recording in (("dark", "dark"), ("flat", "flat"), ("align", "target")):
        assert cli("calibrate", step, taken[recording], "--out", cal, "--json").code == 0
    carrying = record(tmp_path / "run.zarr", white(0.3, EFFECTS), "target", 80, calibration=str(cal))
    words = ("--lines", 60, "--iterations", 5, "--json")
    own = cli("reconstruct", carrying, "--out", tmp_path / "own.zarr", *words)
    assert own.code == 0, own.err
    assert own.json["calibration"]["corrected"] == [
        "offsets per column",
        "gains per column",
        "the arms' balance",
        "arm B laid on arm A",
    ]
    none = cli("reconstruct", carrying, "--out", tmp_path / "none.zarr", "--calibration", "none", *words)
    assert none.json["calibration"] is None
    other = cli(
        "reconstruct", taken["target"], "--out", tmp_path / "other.zarr", "--calibration", cal, *words
    )
    assert other.json["calibration"] == own.json["calibration"]
    pictures = [np.asarray(open_video(tmp_path / f"{name}.zarr").video) for name in ("own", "none")]
    assert np.abs(pictures[0] - pictures[1]).max() > 0.1
    assert "dark, flat, align" in cli("info", carrying).out
    assert "arm B lies" in cli("calibrate", "show", carrying).out


def test_the_effect_of_each_part_is_reported(cli: Cli, taken: dict[str, Path], tmp_path: Path) -> None:
    """The target itself, at rest: without the alignment of arm B its samples are predicted less well."""
    cal = tmp_path / "cal.zarr"
    for step, recording in (("dark", "dark"), ("flat", "flat"), ("align", "target")):
        assert cli("calibrate", step, taken[recording], "--out", cal, "--json").code == 0
    words = ("--calibration", cal, "--lines", 120, "--nm", 1, "--tm", 431)
    explained = cli("reconstruct", taken["target"], "--explain", *words, "--json")
    assert explained.code == 0, explained.err
    parts = {part["part"]: part for part in explained.json["parts"]}
    assert list(parts)[:2] == ["nothing", "all of it"]
    assert parts["all of it"]["prediction"] < parts["nothing"]["prediction"]
    assert parts["arm B laid on arm A"]["gain_db"] > 1
    without = cli("reconstruct", taken["target"], "--explain")
    assert (without.code, "holds no calibration to explain" in without.err) == (2, True)
    words = ("--calibration", cal, "--from", "L150", "--lines", 110, "--nm", 1, "--tm", 431)
    told = cli(
        "reconstruct", taken["target"], "--explain", *words, "--out", tmp_path / "v.zarr", "--json"
    ).json
    assert [part["part"] for part in told["explained"]["parts"]] == list(parts)
    assert "110 lines from line 150," in cli("reconstruct", taken["target"], "--explain", *words).out


def test_one_of_another_instrument_is_refused(cli: Cli, taken: dict[str, Path], tmp_path: Path) -> None:
    cal = tmp_path / "cal.zarr"
    assert cli("calibrate", "dark", taken["dark"], "--out", cal).code == 0
    other = record(tmp_path / "other.zarr", white(0.3), "target", 60, **{"cameras.a.serial": "ELSEWHERE"})
    answer = cli("reconstruct", other, "--out", tmp_path / "v.zarr", "--calibration", cal)
    assert answer.code == 2
    assert "serial is ELSEWHERE instead of SIM-A" in answer.err
    answer = cli("reconstruct", other, "--out", tmp_path / "v.zarr", "--calibration", tmp_path / "no.zarr")
    assert (answer.code, "no.zarr does not exist" in answer.err) == (2, True)
    answer = cli("calibrate", "show", other)
    assert (answer.code, "holds no calibration" in answer.err) == (2, True)


def test_what_is_no_calibration_is_not_called_no_recording(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "cal.zarr").mkdir()
    answer = cli("calibrate", "show", tmp_path / "cal.zarr")
    assert answer.code == 2
    assert "is not a calibration: it holds no zarr.json" in answer.err


@pytest.mark.parametrize("step", ["dark", "linearity", "delay", "all"])
@pytest.mark.parametrize("place", ["/proc/cal.zarr", f"{'n' * 240}.zarr", "none/cal.zarr"])
def test_a_calibration_that_cannot_be_written_is_refused_before_any_work(
    cli: Cli, tmp_path: Path, step: str, place: str
) -> None:
    """It was noticed once the recordings had been made and evaluated; here, there are none and no daemon."""
    words = [] if step == "all" else [tmp_path / "no-recording.zarr"]
    answer = cli("calibrate", step, *words, "--out", tmp_path / place)
    assert answer.code == 2
    assert any(why in answer.err for why in ("cannot be written", "does not exist\n  try: create it first"))
    assert not list(tmp_path.iterdir())


def test_what_is_no_calibration_is_not_replaced_and_refused_at_once(cli: Cli, tmp_path: Path) -> None:
    other = tmp_path / "notes.zarr"
    other.mkdir()
    answer = cli("calibrate", "dark", tmp_path / "no-recording.zarr", "--out", other)
    assert (answer.code, list(tmp_path.iterdir())) == (2, [other])
    assert f"{other} is not a calibration" in answer.err


def test_the_sheet_is_drawn(cli: Cli, tmp_path: Path) -> None:
    """For printing with its size, and as a picture of what the cameras see, for the rig's stages."""
    paper, screen = tmp_path / "target.svg", tmp_path / "target.png"
    answer = cli("calibrate", "sheet", "--out", paper, "--field-mm", 57.6)
    assert answer.code == 0, answer.err
    assert "0.3 mm" in answer.out
    assert "The cameras see 57.6 mm × 57.6 mm of it" in paper.read_text(encoding="utf-8")
    answer = cli("calibrate", "sheet", "--out", screen, "--json")
    # A picture has no millimetres: those of the default field were another size than the print's.
    assert (answer.json["fine pixels"], answer.json["a fine pixel"]) == (192, "8 pixels")
    with Image.open(screen) as picture:
        assert picture.size == (1536, 1536)
    again = cli("calibrate", "sheet", "--out", screen)
    assert again.code == 2
    assert "the file exists and is not overwritten" in again.err
    other = cli("calibrate", "sheet", "--out", tmp_path / "target.pdf")
    assert other.code == 2
    assert "suffix is not a known format" in other.err
    assert "target.svg" in other.err
