"""A glimpse is made of the latest lines, which are cut as from a recording."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import pytest

from acquire.config import RigConfig, load_rig, load_scene
from acquire.daemon.facts import RingPlace, Rings
from acquire.simulate import simulate
from acquire.store import Recording, open_recording
from acquire.stream.peek import Peek
from acquire.stream.ring import Ring, RingShape
from acquire.web.glimpse import Glimpses, Sizes, glimpse_message
from acquire.web.places import shape_of

BLOCK = 50


FIBRE = {"geometry.stages": 16, "fibre.rows": 32, "fibre.columns": 48, "fibre.sensor_pixels": 100}


@pytest.fixture(scope="module", params=["rig-demo", "rig-fibre"])
def rig(request: pytest.FixtureRequest) -> RigConfig:
    return load_rig(request.param, FIBRE if request.param == "rig-fibre" else {"geometry.stages": 16})


@pytest.fixture(scope="module")
def recording(rig: RigConfig, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("glimpse") / "run.zarr"
    simulate(rig, load_scene("scene-leds"), path, 500)
    return open_recording(path)


@pytest.fixture
def rings(recording: Recording) -> Iterator[dict[str, Ring]]:
    """The lines of the recording, in blocks, of which the oldest are gone."""
    width = recording.camera("a").pixels
    made = {arm: Ring(arm, RingShape(8, BLOCK, width, "uint16")) for arm in "ab"}
    for arm, ring in made.items():
        pixels = recording.camera(arm).read("lines", 0, 500)
        for start in range(0, 500, BLOCK):
            if ring.fill == 8:
                ring.acquire()
                ring.release()
            slot = ring.claim(recording.first_line + start, BLOCK)
            assert slot is not None
            slot.pixels[:] = pixels[start : start + BLOCK]
            slot.flags[:] = 0
            ring.commit(slot)
            del slot  # a view keeps the memory
    yield made
    for ring in made.values():
        ring.close()


def places(rings: dict[str, Ring]) -> Rings:
    shape = rings["a"].shape
    facts = {
        name: getattr(shape, name) for name in ("slots", "rows", "width", "dtype", "observers", "reserve")
    }
    return Rings(run_id="r", arms={arm: RingPlace(path=ring.path, **facts) for arm, ring in rings.items()})


def test_it_is_the_segment_that_the_recording_gives(
    rig: RigConfig, recording: Recording, rings: dict[str, Ring]
) -> None:
    told = places(rings)
    assert shape_of(told.arms["a"]) == rings["a"].shape
    with contextlib.closing(Glimpses(rig, told)) as glimpses:
        found = glimpses.segment()
        assert found is not None
        lines = Sizes.of(rig).lines
        cut = recording.cut(recording.first_line + 500 - lines, lines, glimpses.tile)
        np.testing.assert_array_equal(found.lines, cut.lines)
        np.testing.assert_array_equal(found.mask, cut.mask)
        np.testing.assert_array_equal(found.code, cut.code)
        assert (found.first_line, found.substep_ns) == (cut.first_line, pytest.approx(cut.substep_ns))
        assert tuple(np.ravel(found.responsivity_dn)) == (rig.cameras.a.responsivity_dn,) * 2
        video = glimpses.reconstruct(found)
        assert video.video[video.trusted].shape[0] >= 2
        assert video.error == "it was not requested"  # nobody would see it
        assert glimpse_message(video, 0.0, 0.1)


def test_lines_that_are_gone_or_missing_are_not_made_up(rings: dict[str, Ring], recording: Recording) -> None:
    ring, first = rings["a"], recording.first_line
    with contextlib.closing(Peek("a", ring.path, ring.shape)) as peek:
        assert peek.newest_line == first + 500
        pixels = recording.camera("a").read("lines", 0, 500)
        for start, count in ((460, 40), (430, 20), (449, 2), (300, 200)):
            found = peek.stretch(first + start, count)
            assert found is not None
            np.testing.assert_array_equal(found[0], pixels[start : start + count])
        assert peek.stretch(first + 20, 40) is None  # overwritten
        assert peek.stretch(first + 490, 20) is None  # still to come
        ring.acquire()
        ring.release()
        slot = ring.claim(first + 700, BLOCK)  # lines were lost before it
        assert slot is not None
        ring.commit(slot)
        del slot
        assert peek.stretch(first + 490, 220) is None
