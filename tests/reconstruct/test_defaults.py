"""Options of a reconstruction are declared wherever they are typed, and have the same default there."""

from __future__ import annotations

from dataclasses import MISSING, fields
from inspect import signature

import pytest

from acquire.cli.reconstruct import reconstruct as command
from acquire.recon import reconstruct
from acquire.reconstruct import Options

DECLARED = {each.name: each.default for each in fields(Options) if each.default is not MISSING}


@pytest.mark.parametrize("name", sorted(DECLARED.keys() & signature(reconstruct).parameters.keys()))
def test_in_python_for_one_segment_and_for_a_whole_recording(name: str) -> None:
    assert signature(reconstruct).parameters[name].default == DECLARED[name]


@pytest.mark.parametrize(
    # The command's preset depends on what `acquire tradeoff` has found, its calibration on the recording.
    "name",
    sorted((DECLARED.keys() & signature(command).parameters.keys()) - {"preset", "calibration"}),
)
def test_on_the_command_line(name: str) -> None:
    assert signature(command).parameters[name].default == DECLARED[name]
