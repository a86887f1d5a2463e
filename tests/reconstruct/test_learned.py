"""A budget uses the results of trade-offs if there are several scenes."""

from __future__ import annotations

import errno
import json
from dataclasses import replace

import pytest

from acquire.reconstruct.learned import Learned, choose, recall, remember

SCENES = ("leds", "splash", "bullet")


def tried(preset: str, seconds: float, *psnr_db: float) -> list[Learned]:
    return [
        Learned("admm", preset, 3, 1, 1000, scene, seconds, value)
        for scene, value in zip(SCENES, psnr_db, strict=False)
    ]


FAST = tried("fast", 2.0, 25.0, 22.0, 24.0)
GOOD = tried("balanced", 8.0, 32.0, 22.5, 23.5)


def test_the_best_preset_that_ends_in_time():
    known = [*FAST, *GOOD]
    assert choose(known, 10.0, 1000).preset == "balanced"
    assert choose(known, 5.0, 1000).preset == "fast"
    assert choose(known, 5.0, 500).preset == "balanced"  # half the voxels take half the time
    assert choose(known, 1.0, 1000).preset is None
    assert "leds" in choose(known, 10.0, 1000).why
    assert "no preset was tried" in choose([], 1.0, 1000).why


def test_one_scene_alone_is_not_enough():
    one = [*tried("fast", 2.0, 25.0), *tried("balanced", 8.0, 32.0)]
    chosen = choose(one, 10.0, 1000)
    assert chosen.preset is None
    assert "1 scene (leds), and 3 are needed" in chosen.why


def test_presets_are_compared_on_the_same_scenes():
    easy = [*FAST, *(Learned("admm", "fast", 3, 1, 1000, f"easy {n}", 2.0, 60.0) for n in range(5))]
    assert choose([*easy, *GOOD], 10.0, 1000).preset == "balanced"


def test_the_slowest_scene_decides_what_fits():
    slow = [*GOOD[:2], Learned("admm", "balanced", 3, 1, 1000, "bullet", 12.0, 23.5)]
    assert choose([*FAST, *slow], 10.0, 1000).preset == "fast"


def test_voxels_of_another_size_are_never_mixed_in():
    """They are as many by chance; of each scene, the last result in the file counted, whatever its voxels."""
    coarse = [replace(each, spatial_merge=6, temporal_merge=4, psnr_db=90.0) for each in FAST]
    slow = [replace(each, spatial_merge=6, temporal_merge=4, seconds=9.5) for each in GOOD]
    for known in ([*FAST, *GOOD, *coarse, *slow], [*coarse, *slow, *FAST, *GOOD]):
        assert choose(known, 10.0, 1000, (3, 1)).preset == "balanced"
        assert choose(known, 9.0, 1000, (3, 1)).preset == "balanced"
        assert choose(known, 10.0, 1000, (6, 4)).preset == "fast"


def test_without_results_of_that_size_the_one_tried_on_most_scenes_counts():
    few = [replace(each, spatial_merge=6, temporal_merge=4) for each in tried("fast", 0.1, 99.0)]
    for known in ([*few, *FAST, *GOOD], [*FAST, *GOOD, *few]):
        assert choose(known, 10.0, 1000).preset == "balanced"
        assert choose(known, 10.0, 1000, (2, 2)).preset == "balanced"


@pytest.mark.parametrize("step", ["os.fsync", "pathlib.Path.replace", "pathlib.Path.read_text"])
def test_a_disk_that_refuses_leaves_the_results_as_they_were(tmp_path, monkeypatch, step):
    """Results of hours were replaced by the latest alone if they could not be read at that moment."""
    path = tmp_path / "t.json"
    remember(FAST, path)

    def refuse(*_args, **_options):
        raise OSError(errno.ENOSPC, "No space left on device")

    # Forced to the medium before it is renamed, some disks say only then that they are full.
    monkeypatch.setattr(step, refuse)
    with pytest.raises(OSError, match="No space left"):
        remember(GOOD, path)
    monkeypatch.undo()
    assert set(recall(path)) == set(FAST)
    assert list(tmp_path.iterdir()) == [path]


def test_results_are_kept_and_replaced(tmp_path):
    path = tmp_path / "cache" / "t.json"
    assert recall(path) == []
    remember(FAST, path)
    better = Learned("admm", "fast", 3, 1, 1000, "leds", 1.0, 26.0)
    remember([better, *GOOD], path)
    assert set(recall(path)) == {better, *FAST[1:], *GOOD}
    path.write_text("{")
    assert recall(path) == []


@pytest.mark.parametrize("change", [{"seconds": "soon"}, {"voxels": None}, {"psnr_db": []}])
def test_a_file_that_somebody_edited_teaches_nothing(tmp_path, change):
    path = tmp_path / "t.json"
    document = json.loads(remember(FAST, path).read_text())
    document["learned"][0] |= change
    path.write_text(json.dumps(document))
    assert recall(path) == []
