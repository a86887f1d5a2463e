"""The arms' shares of the light: found in lines of scenes that nothing was tuned on, or not claimed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquire.alignment import Alignment
from acquire.lines import Segment
from acquire.recon import reconstruct
from acquire.recon.balance import balance_of, divided
from acquire.recon.diagnosis import diagnose
from acquire.sim.procedural import BLACK_DN, CLEAN, SCENES, CameraNoise, record

SIZES = {"stages": 24, "lines": 120}
DIM = CameraNoise(1e3)


def split(segment: Segment, ratio: float) -> Segment:
    """A recording behind a splitter that gives arm B this many times the light of arm A."""
    shares = np.array([2 / (1 + ratio), 2 * ratio / (1 + ratio)])[:, None, None]
    pixels = np.clip((segment.lines - BLACK_DN) * shares + BLACK_DN, 0, 4095)
    return replace(segment, lines=np.rint(pixels).astype(np.uint16), mask=segment.mask & (pixels < 4095))


@pytest.mark.parametrize(("seed", "camera"), [(811, CLEAN), (812, DIM)], ids=["clean", "dim"])
@pytest.mark.parametrize("scene", SCENES)
def test_equal_arms_are_never_corrected(scene: str, seed: int, camera: CameraNoise) -> None:
    found = balance_of([record(scene, seed, camera=camera, **SIZES).segment])
    assert found is not None
    assert not found.clear
    assert abs(found.ratio - 1) < 4 * found.error


@pytest.mark.parametrize("scene", ["still", "splash", "leds", "disc", "traffic", "runner"])
@pytest.mark.parametrize("ratio", [0.9, 1.25])
def test_a_splitter_is_found_within_its_error(scene: str, ratio: float) -> None:
    found = balance_of([split(record(scene, 813, **SIZES).segment, ratio)])
    assert found is not None
    assert found.clear
    assert found.ratio == pytest.approx(ratio, abs=3 * found.error)


def test_a_light_at_one_edge_is_less_certain_unless_the_arms_are_aligned() -> None:
    segment = record("flame", 819, **SIZES).segment
    anywhere, aligned = (balance_of([replace(segment, alignment=known)]) for known in (None, Alignment()))
    assert anywhere is not None
    assert aligned is not None
    assert anywhere.ratio == aligned.ratio
    assert anywhere.error > 1.5 * aligned.error


def test_several_ranges_are_more_certain_than_one() -> None:
    stretches = [split(record("leds", seed, **SIZES).segment, 1.08) for seed in range(820, 828)]
    one, all_of_them = balance_of(stretches[:1]), balance_of(stretches)
    assert one is not None
    assert all_of_them is not None
    assert all_of_them.error < one.error
    assert all_of_them.ratio == pytest.approx(1.08, abs=3 * all_of_them.error)


def test_masked_samples_and_outliers_are_not_counted_as_light() -> None:
    segment = split(record("still", 814, **SIZES).segment, 1.2)
    mask = segment.mask.copy()
    mask[0, :, 7] = False
    mask[1, 10:14] = False
    found = balance_of([replace(segment, mask=mask)])
    assert found is not None
    assert found.ratio == pytest.approx(1.2, abs=found.error)
    wild = segment.lines.astype(np.float32)
    wild[0, 40, 3], wild[1, 50, 4], wild[1, :, 9] = np.nan, 1e7, 1e6
    found = balance_of([replace(segment, lines=wild)])
    assert found is not None
    assert found.ratio == pytest.approx(1.2, abs=found.error)
    mask[1, :, ::2] = False
    assert balance_of([replace(segment, mask=mask)]) is None


def test_few_lines_darkness_or_a_wrong_black_level_give_no_balance() -> None:
    assert balance_of([]) is None
    assert balance_of([record("still", 815, stages=24, lines=40).segment]) is None
    segment = record("still", 815, **SIZES).segment
    assert balance_of([replace(segment, lines=np.full_like(segment.lines, 100))]) is None
    dark_edge = segment.lines.copy()
    dark_edge[1, :, :8] = 160
    assert balance_of([replace(segment, lines=dark_edge)]) is None


@pytest.mark.parametrize("responsivity", [2.0, (2.0, 3.0), np.array([[2.0], [3.0]]) * np.ones((2, 24))])
def test_the_correction_removes_the_difference_and_keeps_the_mean(responsivity) -> None:
    segment = replace(split(record("still", 816, **SIZES).segment, 1.2), responsivity_dn=responsivity)
    before = balance_of([segment])
    assert before is not None
    after = divided(segment, before)
    assert after.balanced
    again = balance_of([after])
    assert again is not None
    assert again.ratio == pytest.approx(1, abs=1e-6)
    old, new = (np.broadcast_to(np.transpose(each.responsivity_dn), (24, 2)) for each in (segment, after))
    np.testing.assert_allclose((new / old).mean(1), 1)


def test_a_reconstruction_corrects_it_with_a_warning() -> None:
    recorded = record("splash", 817, **SIZES)
    truth = recorded.truth(2, 8)

    def error(segment: Segment) -> tuple[float, tuple[str, ...], object]:
        result = reconstruct(segment, 2, 8, "fast", check=False)
        off = np.sqrt(np.mean(np.square(result.video[result.trusted] - truth)))
        return float(off), result.warnings, result.parameters.get("balance")

    equal, no_words, facts = error(recorded.segment)
    assert not any("arm b" in text for text in no_words)
    assert isinstance(facts, dict)
    assert facts["corrected"] is False
    unequal = split(recorded.segment, 1.2)
    corrected, words, facts = error(unequal)
    assert isinstance(facts, dict)
    assert facts["corrected"] is True
    assert any("arm b gets 1.2" in text for text in words)
    as_it_is, _, nothing = error(replace(unequal, balanced=True))
    assert nothing is None
    assert corrected < 1.05 * equal
    assert as_it_is > 1.5 * equal


def test_a_diagnosis_names_it() -> None:
    segment = record("traffic", 818, **SIZES).segment
    assert "gain_ratio" not in [each.kind for each in diagnose(segment).suspicions]
    assert "gain_ratio" in [each.kind for each in diagnose(split(segment, 1.1)).suspicions]
