"""The options of a reconstruction, which three signatures declare, are the same in all of them."""

from __future__ import annotations

from dataclasses import fields
from inspect import signature

import pytest

from acquire.cli.reconstruct import reconstruct as command
from acquire.recon import reconstruct
from acquire.recon.options import SolveOptions
from acquire.reconstruct import Options

OF_A_VIDEO = {"calibration", "turn", "balance", "shared"}
"""What a call of `reconstruct` does not have: its lines are read already, and it is one of one."""
OF_A_SEGMENT = {
    "segment", "spatial_merge", "temporal_merge",
    # Arrays and objects in memory, which are not sent to processes or written on a command line.
    "initial", "static_image", "tv_weight", "choice", "progress", "look", "stop", "refuse",
}  # fmt: skip
TYPED = {"preset", "solver", "iterations", "dtype", "device", "denoiser"}
"""Options of the command that have the name of the keyword; --budget and --set are parsed first."""


def test_every_option_of_a_video_is_passed_on_or_is_its_own() -> None:
    """One that was misspelt would be left out of `Options.keywords` without a word."""
    passed = set(Options().keywords())
    assert passed.isdisjoint(OF_A_VIDEO)
    assert passed | OF_A_VIDEO == {field.name for field in fields(Options)}
    assert passed | OF_A_SEGMENT == set(signature(reconstruct).parameters)


@pytest.mark.parametrize("name", sorted(Options().keywords()))
def test_defaults_are_the_same(name: str) -> None:
    default = signature(reconstruct).parameters[name].default
    ours = getattr(Options(), name)
    assert ours == default or (ours, default) == ({}, None)
    if name in TYPED - {"preset"}:  # the command looks for the preset that suits the budget
        assert signature(command).parameters[name].default == default


def test_what_a_solver_is_given_is_checked_under_the_names_of_the_call() -> None:
    asked = {field.name for field in fields(SolveOptions)}
    assert asked <= set(signature(reconstruct).parameters)
