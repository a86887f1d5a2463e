"""Ordinary mistakes on the command line: one message that says what to try, and no trace."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Cli = Callable[..., Any]

SCENE = """
kind = "leds"
[[leds]]
name = "x"
shape = "x"
row = 0.5
column = 0.5
size = 0.3
drive = { waveform = "constant" }
"""
AS_A_USER = (
    sys.executable,
    "-c",
    # Without what lets root read any file: tests may run as root.
    "import ctypes, os, sys; [ctypes.CDLL(None).prctl(24, cap, 0, 0, 0) for cap in (1, 2)];"
    "os.execv(sys.executable, [sys.executable, '-m', 'acquire', *sys.argv[1:]])",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a recording of dark lines, their calibration, and a group of each kind in one file."""
    place = tmp_path_factory.mktemp("made")
    (place / "scene.toml").write_text(SCENE + '[[effects]]\nkind = "read_noise"\nsigma_e = 8.0\n')
    dark = [f"--set=cameras.{arm}.black_level_dn=60" for arm in "ab"]
    dark += ["--set", 'code={kind="constant",value=0}', "--lines", "600", "--out", "run.zarr"]
    for words in (
        ("simulate", "scene.toml", "--config", "rig-demo", *dark),
        ("calibrate", "dark", "run.zarr", "--out", "cal.zarr"),
    ):
        run(place, *words, check=True)
    video = {"zarr_format": 3, "node_type": "group", "attributes": {"format": "acquire-video/1"}}
    (place / "video.zarr").mkdir()
    (place / "video.zarr" / "zarr.json").write_text(json.dumps(video))
    (place / "file").write_text("text\n")
    (place / "directory").mkdir()
    return place


def run(
    place: Path,
    *words: str,
    check: bool = False,
    program: tuple[str, ...] = (),
    stdout: Any = subprocess.PIPE,
) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    program = program or (sys.executable, "-m", "acquire")
    environment = {key: value for key, value in os.environ.items() if key != "ACQUIRE_SOCKET"}
    done = subprocess.run(
        [*program, *words],
        check=False,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        timeout=300,
        cwd=place,
        env=environment,
    )
    assert "Traceback" not in done.stderr, done.stderr
    assert not check or done.returncode == 0, done.stderr
    return done


def entries(place: Path) -> set[str]:
    return {str(path.relative_to(place)) for path in place.rglob("*")}


HOME = "try: $HOME in place of ~, which the shell replaces only at the beginning of a word"


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        # a ~ that the shell has left as it is: "create it first" would have made a directory of that name
        (("info", "~/run.zarr"), 2, HOME),
        (("cut", "run.zarr", "--out", "~/cut.npz"), 2, HOME),
        (("simulate", "scene.toml", "--out", "~/x.zarr"), 2, HOME),
        (("reconstruct", "run.zarr", "--out", "~/x.zarr"), 2, HOME),
        (("render", "~/video.zarr", "--out", "x.mp4"), 2, HOME),
        (("calibrate", "show", "~/cal.zarr"), 2, HOME),
        (("config", "check", "~/rig.toml"), 2, HOME),
        # a file, or a part of something, in place of a directory
        (("info", "file"), 2, "file is not a recording: it is a file"),
        (("verify", "file"), 2, "file is not a recording: it is a file"),
        (("calibrate", "show", "file"), 2, "file is not a calibration: it is a file"),
        (("info", "run.zarr/a"), 2, "but not a recording: it states no format"),
        (("calibrate", "show", "run.zarr/a"), 2, "is not a calibration: it states no format"),
        (("render", "run.zarr/a", "--out", "x.mp4"), 2, "is not a video of acquire: it states no format"),
        # a socket that is none: "try: acquire serve --socket file" was refused as well
        (("status", "--socket", "file"), 3, "listens on file, which is a file and not a socket"),
        (("status", "--socket", "directory"), 3, "directory, which is a directory and not a socket"),
        # numbers and options: API names and pydantic's words
        (("start", "--lines", "-5"), 2, "--lines -5 is out of range\n  possible: 1 or more"),
        (("start", "--lines", "5", "--duration", "1s"), 2, "--lines and --duration exclude each other"),
        (("start", "--pre", "5s", "--duration", "2s"), 2, "--pre 5s cannot be as long as --duration 2s"),
        (("start", "--resume"), 2, "possible: acquire start --resume NAME.zarr"),
        (("mark", "x" * 500), 2, ": must have at most 400 characters"),
        (("reconstruct", "run.zarr", "--out", "x.zarr", "--tm", "-1"), 2, "--tm -1 is out of range"),
        (("reconstruct", "run.zarr", "--out", "x.zarr", "--segment", "64"), 2, "possible: LENGTH:NMxTM"),
        # arguments
        (("export", "run.zarr", "--out", "x.tif"), 2, "there is no option --out: the output is an argument"),
        (("export", "run.zarr", "--out", "x.tif"), 2, "possible: acquire export [OPTIONS]"),
        (("export", "run.zarr"), 2, "possible: acquire export [OPTIONS]"),
        (("info", "run.zarr", "cal.zarr"), 2, "info: 'cal.zarr' is more than it takes\n  possible: acquire"),
        (("help", "start"), 2, "try: acquire start --help"),
        (("--config", "rig-demo", "serve"), 2, "try: acquire serve --help"),
        (("completion",), 2, "the argument 'SHELL' is missing\n  possible: bash, zsh, fish"),
        # a shell's variable that is not set: "" was the current directory, or another rig
        (("simulate", "scene-leds", "--out", ""), 2, "the path is empty"),
        (("simulate", "scene-leds", "--out", "x.zarr", "--config", ""), 2, "rig file '' does not exist"),
        (("cut", "run.zarr", "--out", ""), 2, "the path is empty"),
        (("export", "run.zarr", ""), 2, "the path is empty"),
        (("render", "", "--out", "x.mp4"), 2, "the path is empty"),
        (("calibrate", "show", ""), 2, "the path is empty"),
        (("upload", "run.zarr", ""), 2, "the path is empty"),
        (("status", "--socket", ""), 2, "the path is empty"),
        (("start", ""), 2, "the path is empty"),
        # what is no file of lines, and no port
        (
            ("import", "run.zarr", "--out", "x.zarr", "--config", "rig-demo"),
            2,
            "is a directory, and not a file",
        ),
        (("trigger", "info", "--url", "/dev/null"), 5, "/dev/null is not a serial port"),
        (("trigger", "info", "--url", "file"), 5, "file is not a serial port"),
    ],
)
def test_a_mistake_is_told_with_what_to_try(
    cli: Cli, made: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], code: int, told: str
) -> None:
    monkeypatch.chdir(made)
    before = entries(made)
    answer = cli(*words)
    assert (answer.code, told in answer.err) == (code, True), answer.err
    assert entries(made) == before


def test_ls_without_a_directory_lists_the_current_one(
    cli: Cli, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ended in a traceback: the default went through the parser as a path, and not as a text."""
    monkeypatch.chdir(made)
    answer = cli("ls")
    assert (answer.code, "run.zarr" in answer.out) == (0, True), answer.err


@pytest.mark.parametrize(
    "words", [("info", "--help"), ("calibrate", "--help"), ("calibrate", "dark", "--help")]
)
def test_help_that_cannot_be_written_names_standard_output(tmp_path: Path, words: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        done = run(tmp_path, *words, stdout=full)
    assert done.returncode == 5
    assert done.stderr == "acquire: error: standard output: No space left on device\n"


@pytest.mark.parametrize(
    "words", [("ls",), ("simulate", "scene-leds", "--lines", "5", "--out", "x.zarr"), ("demo", "--out", "x")]
)
def test_a_current_directory_that_was_removed_is_named(tmp_path: Path, words: tuple[str, ...]) -> None:
    """It was told as "No such file or directory" alone."""
    gone = tmp_path / "gone"
    gone.mkdir()
    removing = f"import os, sys; os.rmdir({str(gone)!r}); from acquire.cli import main; sys.exit(main())"
    done = run(gone, *words, program=(sys.executable, "-c", removing))
    assert done.returncode == 2
    assert "the current directory does not exist any more\n  try: cd to a directory" in done.stderr


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("cal.zarr", ("calibrate", "show")),
        ("cal.zarr", ("calibrate", "dark", "run.zarr", "--out")),
        ("video.zarr", ("render", "--out", "x.mp4")),
    ],
)
def test_what_may_not_be_read_is_not_told_as_something_else(
    made: Path, tmp_path: Path, name: str, words: tuple[str, ...]
) -> None:
    """A calibration "held no zarr.json", and a video was "damaged: a copy, or reconstruct once more"."""
    for each in ("run.zarr", "cal.zarr", "video.zarr"):
        shutil.copytree(made / each, tmp_path / each)
    (tmp_path / name).chmod(0)
    try:
        done = run(tmp_path, *words, name, program=AS_A_USER)
    finally:
        (tmp_path / name).chmod(0o700)
    assert (done.returncode, f"{name} cannot be read: Permission denied" in done.stderr) == (2, True), done
    assert "try: its permissions" in done.stderr
