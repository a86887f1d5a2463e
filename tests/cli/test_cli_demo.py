"""``acquire demo``: requests that cannot be completed are refused before anything is touched."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquire.cli.demo.capture import end
from acquire.cli.demo.plan import DemoPlan, trigger_settings
from acquire.config import builtin_directory

Cli = Callable[..., Any]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--lines", 1000), "1996 or more"),
        (("--budget", 0), "more than 0"),
        (("--twist-budget", "nan"), "is not a duration"),
        (("--config", "none.toml"), "does not exist"),
    ],
)
def test_impossible_options(cli: Cli, tmp_path: Path, options: tuple[object, ...], words: str) -> None:
    answer = cli("demo", "--out", tmp_path / "new", *options)
    assert answer.code == 2
    assert words in answer.err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("substeps = 3", "substeps = 2", "a multiple of 3"),
        ("stages = 64", "stages = 261", "fewer stages"),
        ('kind = "prbs"\ndegree = 64\nseed = 1', 'kind = "constant"\nvalue = 1', "code.kind"),
    ],
)
def test_rigs_that_show_too_little(cli: Cli, tmp_path: Path, before: str, after: str, words: str) -> None:
    rig = tmp_path / "rig.toml"
    text = (builtin_directory() / "rig-demo.toml").read_text(encoding="utf-8")
    assert before in text
    rig.write_text(text.replace(before, after))
    answer = cli("demo", "--out", tmp_path / "new", "--config", rig)
    assert answer.code == 2
    assert words in answer.err
    assert not (tmp_path / "new").exists()


def test_the_parent_directory_must_exist(cli: Cli, tmp_path: Path) -> None:
    answer = cli("demo", "--out", tmp_path / "none" / "new")
    assert answer.code == 2
    assert f"{tmp_path / 'none'} does not exist" in answer.err


def test_the_report_contains_the_equivalent_command() -> None:
    plain = DemoPlan(Path("out"))
    assert plain.command == "acquire demo --seed 1 --lines 33334"
    other = DemoPlan(Path("out"), "my rig.toml", 3, 5000, 2.0, 1.5)
    assert other.command == (
        "acquire demo --seed 3 --lines 5000 --config 'my rig.toml' --budget 2 --twist-budget 1.5"
    )


def test_the_gateware_gets_few_clocks_in_the_same_substep() -> None:
    assert trigger_settings(DemoPlan(Path("out"))) == {}
    rtl = DemoPlan(Path("out"), trigger="rtl")
    assert trigger_settings(rtl) == {
        "trigger.driver": "rtl",
        "trigger.clock_hz": 6_000_000,
        "trigger.substep_ticks": 60,
        "stream.stall_s": 30,
    }
    assert rtl.command == "acquire demo --seed 1 --lines 33334 --trigger rtl"


def test_without_a_compiler_there_is_no_demo_on_the_gateware(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    answer = cli("demo", "--trigger", "rtl", "--out", tmp_path / "new")
    assert answer.code == 2
    assert "apt install g++" in answer.err
    assert not (tmp_path / "new").exists()


def test_a_daemon_that_does_not_end_is_killed() -> None:
    deaf = "import signal, sys; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", deaf], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert not end(process, timeout_s=0.2)
        assert process.returncode is not None
