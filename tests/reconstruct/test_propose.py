"""A plan from the lines alone, which distinguish rest from change."""

from __future__ import annotations

from acquire.config.scene import ConstantDrive, SineDrive
from acquire.recon.auto import Tempo
from acquire.recon.segments import Voxels
from acquire.reconstruct import by_lines
from acquire.reconstruct.propose import PLACES, _tempos, propose
from acquire.sim.leds import LedConfig, LedSceneConfig
from acquire.simulate import simulate
from acquire.store import open_recording


def scene(drive):
    led = LedConfig(name="l", shape="square", row=0.5, column=0.5, size=0.6, drive=drive)
    return LedSceneConfig(kind="leds", title="one", leds=(led,))


def test_a_scene_at_rest_gets_fine_pixels_and_long_frames(rig, tmp_path):
    simulate(rig, scene(ConstantDrive(waveform="constant", level=0.7)), tmp_path / "r.zarr", 120)
    recording = open_recording(tmp_path / "r.zarr")
    plan = propose(recording, by_lines(recording))
    assert {part.spatial_merge for part in plan.segments} == {1}
    assert all(part.temporal_merge >= 24 for part in plan.segments)
    assert "a still" in plan.segments[0].why


def test_a_scene_that_flickers_gets_short_frames(rig, tmp_path):
    drive = SineDrive(waveform="sine", frequency_hz=2000.0, low=0.05)
    simulate(rig, scene(drive), tmp_path / "r.zarr", 120)
    recording = open_recording(tmp_path / "r.zarr")
    plan = propose(recording, by_lines(recording))
    assert max(part.temporal_merge for part in plan.segments) <= 16
    assert plan.segments[-1].is_open


def test_a_long_recording_is_examined_in_some_places_and_where_it_changes():
    still, fast = (Tempo(voxels, ((0, 0.1),)) for voxels in (Voxels(1, 770), Voxels(3, 4)))
    looked, told = [], []

    def look(number, done):
        looked.append(number)
        done(0.5)
        return fast if 70 <= number < 101 else still

    found = _tempos(130, look, lambda done, of: told.append((done, of)))
    assert found == [still] * 70 + [fast] * 31 + [still] * 29
    assert len(looked) == len(set(looked)) <= PLACES + 2 * 4
    assert told[-1] == (len(looked), len(looked))
    assert told[0] == (0.5, PLACES)
    assert _tempos(3, lambda *_: still, None) == [still] * 3


def test_stills_of_other_lengths_are_alike():
    looked: list[int] = []

    def look(lengths):
        looked.clear()
        return lambda number, _: looked.append(number) or Tempo(Voxels(1, lengths[number % 2]), ((0, 0.1),))

    assert len(_tempos(50, look((770, 767)), None)) == 50
    assert len(looked) == PLACES
    # A moving scene among them is looked for, however long its frames.
    _tempos(50, look((770, 64)), None)
    assert len(looked) > PLACES
