"""Where a flat's light ends, and what may be claimed of the gains of the columns at its edge."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments import NOISE, dots, record, white

from acquire.alignment import Alignment
from acquire.blur import falling
from acquire.calibrate import Calibration, Measured
from acquire.calibrate.calibration import Instrument
from acquire.calibrate.columns import dark, dark_edges, edge_doubt, flat
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.field import field_edge, profile
from acquire.calibrate.target import alignment

PRNU = {"kind": "prnu", "prnu": 0.02}
FEW = 24


def measured(directory: Path, effects: Any, *, smooth: bool = False) -> tuple[Calibration, tuple[str, ...]]:
    """Dark, flat and target of an instrument, and what `align` warns of."""
    plain = white(effects=effects)
    scenes = {"dark": plain, "flat": plain, "target": dots(directory, effects)}
    taken = {
        name: open_exposure(record(directory / f"{name}.zarr", scene, name, 1024))
        for name, scene in scenes.items()
    }
    first = dark(taken["dark"])
    known = Calibration(first.instrument).with_step(first)
    known = known.with_step(flat(taken["flat"], known, smooth=smooth))
    found = alignment(taken["target"], known)
    return known.with_step(found), found.warnings


def test_the_edges_gains_are_as_uncertain_as_they_are_wrong() -> None:
    """The outermost columns lack up to as much light as columns differ by: nothing shows that they do."""
    rng, spread, scores = np.random.default_rng(11), 0.018, []
    for _ in range(300):
        lack = spread * rng.uniform(0, 2, (2, 1))
        shape = 1 + spread * rng.standard_normal((2, 64))
        shape[:, [0, -1]] -= lack
        usable = np.ones(shape.shape, bool)
        dark = dark_edges(shape, usable)
        doubt = edge_doubt(shape, usable, dark)[:, None]
        seen = ~dark[:, [0, -1]]
        lacks, doubts = (np.broadcast_to(each, (2, 2))[seen] for each in (lack, doubt))
        scores += (lacks / doubts).tolist()
    assert len(scores) > 300
    # as of a normal distribution
    assert np.quantile(scores, 0.99) < 2.33
    # nor are they far more uncertain than that
    assert np.sqrt(np.mean(np.square(scores))) > 0.5


def flat_of(response: np.ndarray) -> Calibration:
    """A calibration whose flat gave this response of arm B."""
    cameras = {arm: {"serial": arm} for arm in "ab"}
    instrument = Instrument(stages=FEW, substeps=3, substep_s=1e-5, layout="dual", cameras=cameras)
    gains = np.stack([np.ones(FEW), response / response.mean()])
    quantities = {
        "gain": Measured(gains, np.full((2, FEW), 2e-4)),
        "balance": Measured(np.ones(2), np.full(2, 1e-4)),
    }
    return Calibration(instrument, quantities, steps={"flat": {"edge_response": {}}})


@pytest.mark.parametrize("seed", range(4))
def test_a_lens_with_its_axis_aside_is_not_the_fields_end(seed: int) -> None:
    """The images of few columns may not show it clearly, but the columns do."""
    own = 1 + 0.004 * np.random.default_rng(seed).standard_normal(FEW)
    x = np.linspace(-1, 1, FEW)
    aside = Alignment(rows=0.35, columns=0.3)
    lens = falling((0.0, -0.14), x)
    assert not field_edge(flat_of(own * lens), aside).ends
    ending = field_edge(flat_of(own * profile(aside, FEW, 3)), aside)
    both = field_edge(flat_of(own * lens * profile(aside, FEW, 3)), aside)
    assert ending.ends
    assert both.ends
    assert ending.quantities["gain"].value[1] == pytest.approx(own / own.mean(), abs=1e-3)


def test_a_flat_that_does_not_tell_widens_what_it_claims() -> None:
    """Half of the light that would be missing is."""
    off = Alignment(rows=0.5, turn_deg=0.2)
    lit = profile(off, FEW, 3)
    found = field_edge(flat_of((1 + lit) / 2), off)
    assert not found.ends
    doubt = found.quantities["gain"].uncertainty[1]
    assert doubt[-1 if lit[-1] < lit[0] else 0] > 0.04
    assert (found.quantities["gain"].value == flat_of((1 + lit) / 2).quantities["gain"].value).all()
    told = field_edge(flat_of(np.ones(FEW)), off)
    assert not told.quantities


def test_a_smooth_flat_says_that_the_lens_stays(tmp_path: Path) -> None:
    effects = [*NOISE, PRNU, {"kind": "vignetting", "loss": 0.3, "arm": "b"}]
    known, warnings = measured(tmp_path, effects, smooth=True)
    assert "shading" not in known.quantities
    assert "--smooth has no profile of the lens" in " ".join(warnings)
