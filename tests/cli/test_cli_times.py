"""One grammar of times and of line ranges, on every command that takes them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from acquire.cli.durations import parse_duration_ns, seconds, seconds_between
from acquire.cli.moments import after_ns, line_number
from acquire.cli.reconstruct_request import parse_segment, parse_voxels
from acquire.cli.usage import build
from acquire.config import load_rig, load_scene
from acquire.errors import UsageError
from acquire.simulate import simulate

Cli = Callable[..., Any]
LINES = 1200
FIRST = 0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("times") / "run.zarr"
    simulate(load_rig("rig-demo", {"geometry.stages": 8}), load_scene("scene-leds"), path, LINES)
    return path


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("5", 5_000_000_000),
        ("5s", 5_000_000_000),
        ("0.052 s", 52_000_000),
        ("500ms", 500_000_000),
        ("2min", 120_000_000_000),
        ("1.5h", 5_400_000_000_000),
        ("300us", 300_000),
        ("300µs", 300_000),
        ("20ns", 20),
        ("1e-3", 1_000_000),
    ],
)
def test_durations(text: str, ns: int) -> None:
    assert parse_duration_ns(text) == ns
    assert seconds(text) == pytest.approx(ns * 1e-9)


@pytest.mark.parametrize("text", ["", "five", "5 parsecs", "-1s", "nan", "1e400", "L5"])
def test_an_invalid_duration_is_refused_with_valid_ones(text: str) -> None:
    with pytest.raises(UsageError, match="cannot be read") as refused:
        parse_duration_ns(text)
    assert "500ms" in str(refused.value.possible)
    with pytest.raises(typer.BadParameter, match="500ms"):
        seconds(text)


@pytest.mark.parametrize("text", ["1e200s", "350640h", "1e10"])
def test_an_absurd_duration_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="more than 30 years"):
        parse_duration_ns(text)
    with pytest.raises(typer.BadParameter, match="more than 30 years"):
        seconds(text)


def test_limits_of_a_duration_are_named() -> None:
    assert seconds_between(0.1, 60)("2s") == 2
    with pytest.raises(typer.BadParameter, match=r"0\.1 to 60 s"):
        seconds_between(0.1, 60)("2min")


def test_moments() -> None:
    assert after_ns(None, lambda: 0) is None
    assert after_ns("52ms", lambda: 7) == 52_000_000
    assert after_ns("5", lambda: 7) == 5_000_000_000
    assert after_ns("1970-01-01T00:00:02", lambda: 10**9) == 10**9
    assert after_ns("L20", lambda: 0, lambda line: 3 * line) == 60
    assert line_number("l7") == 7
    with pytest.raises(UsageError, match="a video has frames"):
        after_ns("L20", lambda: 0)


@pytest.mark.parametrize(
    "parse",
    [
        lambda digits: after_ns(f"L{digits}", lambda: 0, lambda line: line),
        lambda digits: parse_voxels(f"{digits}x1"),
        lambda digits: parse_segment(f"{digits}:3x4"),
        lambda _: parse_segment("²:3x4"),
    ],
)
@pytest.mark.parametrize("count", [400, 5000])
def test_what_no_number_can_be_made_of_is_refused_in_words(
    parse: Callable[[str], object], count: int
) -> None:
    with pytest.raises(UsageError, match="cannot be read"):
        parse("9" * count)


@pytest.mark.parametrize(
    "words",
    [
        ("--first-line", "300", "--lines", "90"),
        ("--from", "L300", "--to", "L390"),
        ("--from", "9ms", "--to", "11.7ms"),
        ("--from", "0.009", "--to", "11700us"),
        ("--from", "L300", "--lines", "90"),
        ("--first-line", "300", "--to", "11.7ms"),
    ],
    ids=" ".join,
)
def test_a_range_is_given_in_lines_or_in_times(
    cli: Cli, recording: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    assert cli("cut", recording, *words, "--out", tmp_path / "part.npz").code == 0
    assert np.load(tmp_path / "part.npz")["lines"].shape[1] == 90
    cut = cli("export", recording, tmp_path / "part2.npz", *words, "--json").json
    assert cut["shape"] == [2, 90, 8]
    diagnosed = cli("diagnose", recording, *words, "--json").json
    assert (diagnosed["first_line"], diagnosed["lines"]) == (300, 90)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--first-line", "3", "--from", "9ms"), "given twice"),
        (("--lines", "3", "--to", "9ms"), "given twice"),
        (("--from", "9ms", "--to", "8ms"), "there are no lines from 9ms to 8ms"),
        (("--from", "soon"), "the time 'soon' cannot be read"),
        (("--from", "L2000", "--lines", "9"), "has no line at or after L2000"),
        (("--first-line", "2000"), "has no line 2000"),
        (("--first-line", "-1"), "has no line -1"),
    ],
)
def test_an_invalid_range_is_refused(
    cli: Cli, recording: Path, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    answer = cli("cut", recording, *words, "--out", tmp_path / "part.npz")
    assert answer.code == 2
    assert said in answer.err
    assert not (tmp_path / "part.npz").exists()


def test_hold_requires_both_ends(cli: Cli, recording: Path) -> None:
    answer = cli("hold", recording, "--first-line", "5")
    assert answer.code == 2
    assert "--from and --to" in answer.err


def test_a_recording_is_as_long_as_its_duration_says(cli: Cli, tmp_path: Path) -> None:
    assert cli("simulate", "scene-leds", "--out", tmp_path / "five.zarr", "--duration", "5ms").code == 0
    assert cli("info", tmp_path / "five.zarr", "--json").json["lines"] == 167


def test_every_option_that_takes_a_time_takes_the_same_words() -> None:
    """None is a bare number of seconds any more."""

    def walk(command: Any, path: str) -> list[str]:
        found = [
            f"{path} {option.opts[0]}"
            for option in command.params
            if option.metavar == "SECONDS"
            or (option.name in {"seconds", "budget", "timeout", "duration"} and option.metavar != "TIME")
        ]
        return found + [
            w for name, b in getattr(command, "commands", {}).items() for w in walk(b, f"{path} {name}")
        ]

    assert walk(typer.main.get_command(build()), "acquire") == []


def test_help_of_each_option_is_complete() -> None:
    """No help refers to the option above it: no "Its end.", no "Of that", no "Of a panel."."""
    leaning = ("Its ", "Of ", "Instead", "The same", "Repeatable", "Else")

    def walk(command: Any, path: str) -> list[str]:
        found = [
            f"{path} {option.opts[0]}: {option.help}"
            for option in command.params
            if not option.help or option.help.startswith(leaning)
        ]
        return found + [
            w for name, b in getattr(command, "commands", {}).items() for w in walk(b, f"{path} {name}")
        ]

    assert walk(typer.main.get_command(build()), "acquire") == []
