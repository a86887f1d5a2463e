"""Verdicts on lines of every built-in kind of scene, whose light follows the code or does not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from acquire.codes import Code, ConstantCode, PrbsCode
from acquire.config import load_rig, load_scene
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.sim.pipeline import Bench
from acquire.stream.lightcheck import ArmVerdict, Judge, Sight, Verdict, explain, predict

LINES, FIRST = 8192, 1000
SCENES = {
    "scene-leds": "rig-demo",
    "scene-leds-measured": "rig-demo",
    "scene-leds-emulated": "rig-emulated",
    "scene-usaf": "rig-fast",
    "scene-goldfish": "rig-goldfish",
    "scene-usaf-interline": "rig-interline",
}
"""Flickering, noisy, merged, still, moving; S = 1."""


@dataclass(frozen=True)
class Altered:
    """A code that is not quite the light's."""

    code: Code
    late: int = 0
    inverted: bool = False

    def bits(self, start: int, length: int) -> np.ndarray:
        return self.code.bits(start - self.late, length) ^ self.inverted

    def to_attrs(self) -> dict[str, object]:
        return self.code.to_attrs()


@cache
def recorded(scene: str) -> tuple[dict[str, np.ndarray], int, int, int, Code]:
    """Lines of both arms, M, S, white, and the light's code."""
    rig = load_rig(SCENES[scene])
    code = rig.code.build()
    cameras = {arm: rig.cameras.arm(arm) for arm in "ab"}
    bench = Bench(load_scene(scene), rig.geometry, cameras, rig.trigger.substep_ticks / rig.trigger.clock_hz)
    lines = {arm: bench.camera(arm, code).read(FIRST, LINES).pixels for arm in "ab"}
    return lines, rig.geometry.stages, rig.geometry.substeps, rig.cameras.a.white_dn, code


def sights(lines: dict[str, np.ndarray]) -> dict[str, Sight]:
    return {arm: Sight(pixels.mean(axis=1), pixels.mean(axis=0)) for arm, pixels in lines.items()}


def verdicts(scene: str, **altered: object) -> dict[str, ArmVerdict]:
    """On lines that are held against another code than the light's."""
    lines, stages, substeps, white, code = recorded(scene)
    judge = Judge(stages, substeps, Altered(code, **altered), white, {})
    return judge.look(FIRST, sights(lines))


@pytest.mark.parametrize("scene", SCENES)
def test_light_that_follows_the_code_is_verified(scene: str) -> None:
    for finding in verdicts(scene).values():
        assert (finding.verdict, finding.shift) == (Verdict.VERIFIED, 0)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("late", [1, -1, 3, -64, 1000])
def test_a_shift_is_measured_to_the_substep(scene: str, late: int) -> None:
    for finding in verdicts(scene, late=late).values():
        assert (finding.verdict, finding.shift) == (Verdict.SHIFTED, -late)


@pytest.mark.parametrize("scene", SCENES)
def test_the_wrong_polarity_is_recognised(scene: str) -> None:
    for finding in verdicts(scene, inverted=True).values():
        assert (finding.verdict, finding.shift) == (Verdict.INVERTED, 0)


@pytest.mark.parametrize("scene", SCENES)
def test_another_code_is_recognised(scene: str) -> None:
    for finding in verdicts(scene, late=-(10**6)).values():
        assert finding.verdict is Verdict.WRONG_CODE


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("slip", [1, -2])
def test_an_arm_that_slipped_by_lines_is_distinguished_from_the_other(scene: str, slip: int) -> None:
    lines, stages, substeps, white, code = recorded(scene)
    slipped = {"a": lines["a"][4:-4], "b": np.roll(lines["b"], slip, axis=0)[4:-4]}
    found = Judge(stages, substeps, code, white, {}).look(FIRST + 4, sights(slipped))
    assert found["a"].verdict is Verdict.VERIFIED
    assert (found["b"].verdict, found["b"].shift) == (Verdict.SHIFTED, slip * substeps)
    assert explain(found, substeps).endswith(
        f"arm b is {abs(slip)} lines {'behind' if slip > 0 else 'ahead of'} arm a"
    )


def overexposed(gain: float, late: int) -> tuple[dict[str, ArmVerdict], dict[str, float]]:
    """Verdicts on light that is ``gain`` times too bright, and its share in saturated samples."""
    lines, stages, substeps, white, code = recorded("scene-leds")
    clipped = {arm: np.minimum(gain * pixels, white) for arm, pixels in lines.items()}
    shares = {
        arm: float((pixels * (pixels >= white)).sum() / pixels.sum()) for arm, pixels in clipped.items()
    }
    seen = {
        arm: Sight(pixels.mean(axis=1), pixels.mean(axis=0), shares[arm]) for arm, pixels in clipped.items()
    }
    return Judge(stages, substeps, Altered(code, late=late), white, {}).look(FIRST, seen), shares


@pytest.mark.parametrize("late", [0, -40])
def test_light_that_saturates_the_camera_is_no_evidence_against_the_code(late: int) -> None:
    for gain in (4.0, 20.0, 100.0, 1e4):
        found, shares = overexposed(gain, late)
        assert max(shares.values()) > 0.5
        assert {finding.verdict for finding in found.values()} <= {Verdict.UNKNOWN, Verdict.VERIFIED}
        assert not (late and Verdict.VERIFIED in {finding.verdict for finding in found.values()})


@pytest.mark.parametrize("degree", [3, 4, 5])
def test_a_code_that_repeats_within_the_sensor_is_no_evidence(degree: int) -> None:
    settings = {"geometry.stages": 16, "geometry.substeps": 3, "code.degree": degree}
    rig = load_rig("rig-demo", settings)
    cameras = {arm: rig.cameras.arm(arm) for arm in "ab"}
    step_s = rig.trigger.substep_ticks / rig.trigger.clock_hz
    bench, code = Bench(load_scene("scene-leds"), rig.geometry, cameras, step_s), rig.code.build()
    judge = Judge(16, 3, code, rig.cameras.a.white_dn, {})
    for first in range(0, 40_000, 8000):
        lines = {arm: bench.camera(arm, code).read(first, 2500).pixels for arm in "ab"}
        for finding in judge.look(first, sights(lines)).values():
            assert not finding.verdict.doubtful


@pytest.mark.parametrize("late", [0, -40])
def test_light_that_saturates_some_samples_is_judged(late: int) -> None:
    found, shares = overexposed(2.5, late)
    assert min(shares.values()) > 0.02
    for finding in found.values():
        assert (finding.verdict, finding.shift) == (Verdict.SHIFTED if late else Verdict.VERIFIED, -late)


def test_a_known_registration_is_no_shift() -> None:
    lines, stages, substeps, white, code = recorded("scene-usaf")
    judge = Judge(stages, substeps, Altered(code, late=-2), white, {"a": 2, "b": 2})
    assert {finding.verdict for finding in judge.look(FIRST, sights(lines)).values()} == {Verdict.VERIFIED}


@pytest.mark.parametrize("scene", SCENES)
def test_lines_without_an_image_are_left_out(scene: str) -> None:
    lines, stages, substeps, white, code = recorded(scene)
    seen = sights(lines)
    for number, sight in enumerate(seen.values()):
        sight.energy[np.random.default_rng(number).random(LINES // 64).repeat(64) < 0.3] = np.nan
    for late, verdict in ((0, Verdict.VERIFIED), (-2, Verdict.SHIFTED)):
        found = Judge(stages, substeps, Altered(code, late=late), white, {}).look(FIRST, seen)
        assert {(each.verdict, each.shift) for each in found.values()} == {(verdict, -late)}


@pytest.mark.parametrize("scene", SCENES)
def test_faint_light_that_follows_the_code_is_not_dark(scene: str) -> None:
    lines, stages, substeps, white, code = recorded(scene)
    brightest = max(pixels.mean() for pixels in lines.values())
    faint = {arm: np.round(pixels * (0.001 * white / brightest)) for arm, pixels in lines.items()}
    found = Judge(stages, substeps, code, white, {}).look(FIRST, sights(faint))
    assert {finding.verdict for finding in found.values()} == {Verdict.VERIFIED}
    other = Judge(stages, substeps, Altered(code, late=-3), white, {}).look(FIRST, sights(faint))
    assert {finding.verdict for finding in other.values()} == {Verdict.DARK}


def test_dark_light_sources_are_recognised() -> None:
    lines, stages, substeps, white, code = recorded("scene-usaf")
    rng = np.random.default_rng(3)
    judge = Judge(stages, substeps, code, white, {})
    nothing = {arm: rng.poisson(2.0, pixels.shape) for arm, pixels in lines.items()}
    daylight = {arm: rng.poisson(pixels.mean(axis=0), pixels.shape) for arm, pixels in lines.items()}
    one_arm = lines | {"b": nothing["b"]}
    told = {
        name: [finding.verdict for finding in judge.look(FIRST, sights(seen)).values()]
        for name, seen in (("nothing", nothing), ("daylight", daylight), ("one", one_arm))
    }
    assert told == {
        "nothing": [Verdict.DARK, Verdict.DARK],
        "daylight": [Verdict.DARK, Verdict.DARK],
        "one": [Verdict.UNKNOWN, Verdict.DARK],
    }


@pytest.mark.parametrize(("value", "verdict"), [(1, Verdict.UNKNOWN), (0, Verdict.UNKNOWN)])
def test_a_constant_light_tells_nothing_of_a_code(value: int, verdict: Verdict) -> None:
    lines, stages, substeps, white, _ = recorded("scene-usaf")
    judge = Judge(stages, substeps, ConstantCode(value), white, {})
    assert {finding.verdict for finding in judge.look(FIRST, sights(lines)).values()} == {verdict}


@pytest.mark.parametrize("substeps", [1, 2, 3])
def test_the_prediction_is_the_forward_model_s(substeps: int) -> None:
    """Of a scene that does not change, from the other arm's pixels, up to one factor."""
    geometry = Geometry(6, substeps, 40)
    code = PrbsCode.from_seed(20, 1).bits(0, geometry.span)
    row = np.repeat(np.random.default_rng(5).random(6), substeps)  # as fine as the other arm's pixels
    picture = np.outer(row, np.ones(geometry.size))
    lines = DualArm(geometry, code, dtype=np.float64).forward(
        np.broadcast_to(picture, geometry.video_shape()).copy()
    )
    energy = predict(row[::substeps], code, substeps)[::substeps]
    seen = lines[0].sum(axis=1)
    assert np.allclose(energy[: len(seen)] / energy[: len(seen)].sum(), seen / seen.sum())
