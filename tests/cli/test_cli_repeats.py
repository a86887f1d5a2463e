"""Two values for an option that takes one: click took the last one without a word."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from acquire.cli.commands import MODULES
from acquire.cli.usage import command_of

Cli = Callable[..., Any]


def options() -> Iterator[tuple[Any, Any]]:
    """Every command, with each of its options that takes a value."""
    commands = [command_of(MODULES)]
    while commands:
        command = commands.pop()
        commands += getattr(command, "commands", {}).values()
        for option in command.params:
            if option.param_type_name == "option" and not option.is_flag:
                yield command, option


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "start x.zarr --lines 10 --lines 20",
            "acquire: warning: start: --lines is given twice: 20 counts, not 10",
        ),
        ("serve -c rig-a --config=rig-b", "serve: --config (-c) is given twice: rig-b counts, not rig-a"),
        (
            "reconstruct x.zarr --nm 2 --out v.zarr --spatial-merge 3",
            "reconstruct: --spatial-merge (--nm) is given twice: 3 counts, not 2",
        ),
        (
            "calibrate forget veil --out a.zarr --out b.zarr",
            "calibrate forget: --out is given twice: b.zarr counts, not a.zarr",
        ),
    ],
)
def test_both_values_are_named(cli: Cli, words: str, said: str) -> None:
    """A warning: an alias that has defaults may be given other values."""
    answer = cli(*words.split())
    assert said in " ".join(answer.err.split())
    assert "is given twice" not in answer.out


def test_every_option_takes_one_value_or_is_repeatable(capsys: pytest.CaptureFixture[str]) -> None:
    seen = {True: 0, False: 0}
    for command, option in options():
        context = command.context_class(command, info_name=f"acquire {command.name}")
        words = [word for number in "12" for word in (max(option.opts, key=len), *[number] * option.nargs)]
        command.make_parser(context).parse_args(words)
        said = " ".join(capsys.readouterr().err.split())
        assert option.multiple != ("is given twice" in said), (command.name, option.name)
        seen[option.multiple] += 1
    assert seen[False] > 200
    assert seen[True] > 10


def test_a_value_that_is_repeated_and_one_of_the_environment_are_no_second_value(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = cli("start", "x.zarr", "--lines", "10", "--lines=10", "--socket", "none.sock")
    assert answer.code == 3
    assert "twice" not in answer.err
    monkeypatch.setenv("ACQUIRE_SOCKET", "one.sock")
    answer = cli("status", "--socket", "two.sock")
    assert answer.code == 3
    assert "two.sock" in answer.err
    assert "twice" not in answer.err
    # a line that is not complete yet is read as far as it goes
    monkeypatch.setenv("COMP_WORDS", "acquire start x.zarr --lines 10 --lines 20 --pr")
    monkeypatch.setenv("COMP_CWORD", "7")
    monkeypatch.setenv("_ACQUIRE_COMPLETE", "complete_bash")
    assert "--pre" in cli().out
