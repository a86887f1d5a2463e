"""What `acquire calibrate all` looks at before it records: the order of the steps, and the delays in use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.calibrate import Calibration, save_calibration
from acquire.calibrate.calibration import Finding, Instrument, Measured
from acquire.calibrate.guide import DARK, FLAT, TARGET, VEIL
from acquire.cli.calibrate_all import _refuse_out_of_order, _warn_of_delays
from acquire.errors import UsageError

INSTRUMENT = Instrument(stages=8, substeps=3, substep_s=1e-5, layout="dual", cameras={})


COLUMNS = Measured(np.zeros((2, 8)), np.ones((2, 8)))
FOUND = {
    "dark": {"offset_dn": COLUMNS, "noise_dn": COLUMNS},
    "delay": {"light_late_ticks": Measured(np.zeros(2), np.ones(2))},
}


def saved(path: Path, step: str, **facts: Any) -> str:
    known = Calibration(INSTRUMENT).with_step(Finding(step, INSTRUMENT, FOUND[step], facts=facts))
    save_calibration(path, known)
    return str(path)


def test_a_step_that_needs_another_is_refused_before_it_records(tmp_path: Path) -> None:
    nothing = str(tmp_path / "none.zarr")
    _refuse_out_of_order([DARK, FLAT, TARGET, VEIL], nothing)
    for step in (FLAT, VEIL):
        with pytest.raises(UsageError, match=f"{step.name} needs the offsets of the columns first"):
            _refuse_out_of_order([TARGET, step], nothing)
    _refuse_out_of_order([FLAT], saved(tmp_path / "dark.zarr", "dark"))


def test_delays_that_were_measured_but_are_not_in_use_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measured = saved(tmp_path / "c.zarr", "delay", rig={"light.lead_ticks": 216, "a.delay_ticks": 44})
    trigger = {"light": {"lead_ticks": 216}, "a": {"delay_ticks": 0}, "b": {"delay_ticks": 0}}
    _warn_of_delays(measured, trigger)
    said = " ".join(capsys.readouterr().err.split())
    assert "the rig lacks the delays that were measured" in said
    assert "trigger.light.lead_ticks = 216; trigger.a.delay_ticks = 44" in said
    _warn_of_delays(measured, {**trigger, "a": {"delay_ticks": 44}})
    # neither without a calibration, nor with one that has not measured them
    _warn_of_delays(str(tmp_path / "none.zarr"), trigger)
    _warn_of_delays(saved(tmp_path / "dark.zarr", "dark"), trigger)
    assert capsys.readouterr().err == ""
