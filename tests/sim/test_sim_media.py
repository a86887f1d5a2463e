"""The user's files and functions as scenes, of any size and rate, and clear errors for invalid ones."""

from __future__ import annotations

import os

import av
import numpy as np
import pytest
from PIL import Image

from acquire.config import load_scene
from acquire.config.scene import SceneFile
from acquire.errors import DataError, UsageError
from acquire.sim.media import _KEPT_FRAMES, StillScene, VideoScene, VideoSceneConfig, resample
from acquire.sim.scenes import build_scene
from acquire.sim.sprites import SpriteConfig, SpritesSceneConfig

RNG = np.random.default_rng(3)


def shown(path, size=6, substep_s=1e-3, **changes):
    return VideoScene(VideoSceneConfig(kind="video", path=path, **changes), size, substep_s)


def write_container(path, frames, rate, codec):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.height, stream.width = frames.shape[1:]
        stream.pix_fmt = "gray" if codec == "ffv1" else "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
        container.mux(stream.encode())


def test_resampling_keeps_the_light_and_makes_squares_of_big_pixels():
    picture = RNG.random((7, 31)).astype(np.float32)
    for size in (3, 7, 12, 40):
        assert resample(picture, size).mean() == pytest.approx(picture.mean(), rel=1e-5)
    np.testing.assert_allclose(resample(picture[:, :7], 21)[:3, :3], picture[0, 0], rtol=1e-6)


def test_an_array_is_shown_frame_by_frame_in_a_loop(tmp_path):
    video = RNG.random((4, 6, 6)).astype(np.float32)
    np.save(tmp_path / "v.npy", video)
    scene = shown(tmp_path / "v.npy", frame_rate_hz=500.0, between="hold")
    np.testing.assert_allclose(scene.frames(-2, 12), video[np.arange(-2, 10) // 2 % 4], rtol=1e-6)
    last = shown(tmp_path / "v.npy", frame_rate_hz=500.0, between="hold", end="last")
    np.testing.assert_allclose(last.frames(20, 2), video[[3, 3]], rtol=1e-6)
    blended = shown(tmp_path / "v.npy", frame_rate_hz=500.0).frames(0, 2)
    expected = [0.75 * video[0] + 0.25 * video[1], 0.25 * video[0] + 0.75 * video[1]]
    np.testing.assert_allclose(blended, expected, rtol=1e-5)


def test_an_array_in_fortran_order_is_shown_as_any_other(tmp_path):
    video = RNG.integers(0, 256, (4, 6, 8), dtype=np.uint8)
    np.save(tmp_path / "c.npy", video)
    np.save(tmp_path / "f.npy", np.asfortranarray(video))
    frames = [shown(tmp_path / name, frame_rate_hz=500.0).frames(0, 8) for name in ("c.npy", "f.npy")]
    np.testing.assert_array_equal(*frames)


@pytest.mark.parametrize("change", ["cut short", "written anew", "removed"])
def test_an_array_that_changes_while_it_is_shown_is_refused(tmp_path, change):
    """One that was mapped ended the process (SIGBUS) when it was cut short."""
    path = tmp_path / "v.npy"
    video = RNG.random((200, 64, 64)).astype(np.float32)
    np.save(path, video)
    scene = shown(path, frame_rate_hz=1000.0)
    if change == "cut short":
        os.truncate(path, 4096)
    elif change == "written anew":
        np.save(path, video[:100])
    else:
        path.unlink()
    with pytest.raises(DataError, match=r"v\.npy(: frame 100 cannot be read| has changed while)"):
        scene.frames(100, 1)


def test_only_a_few_frames_are_kept(tmp_path):
    np.save(tmp_path / "v.npy", RNG.random((200, 6, 6)).astype(np.float32))
    scene = shown(tmp_path / "v.npy", frame_rate_hz=1000.0)
    scene.frames(0, 600)
    assert len(scene._kept) <= _KEPT_FRAMES


@pytest.mark.parametrize("name", ["still.png", "still.tiff", "moving.gif", "moving.webp"])
def test_pictures_and_animations(tmp_path, name):
    frames = [Image.fromarray(np.full((9, 12), grey, np.uint8)) for grey in (51, 204)]
    more = {"save_all": True, "append_images": frames[1:], "duration": 20, "loop": 0, "lossless": True}
    frames[0].save(tmp_path / name, **(more if name.startswith("moving") else {}))
    scene = build_scene(load_scene(tmp_path / name), 6, 1e-3)
    light = scene.frames(0, 30).mean(axis=(1, 2))
    assert light[0] == pytest.approx(0.2, abs=0.03)
    assert light[20] == pytest.approx(0.8 if name.startswith("moving") else 0.2, abs=0.03)


@pytest.mark.parametrize(("name", "codec"), [("v.mkv", "ffv1"), ("v.mp4", "mpeg4"), ("v.avi", "mpeg4")])
def test_video_containers_at_their_own_rate_and_backwards(tmp_path, name, codec):
    grey = np.array([20, 60, 100, 140, 180, 220, 240, 120], np.uint8)
    write_container(tmp_path / name, np.broadcast_to(grey[:, None, None], (8, 32, 48)).copy(), 25, codec)
    scene = shown(tmp_path / name, size=4, substep_s=0.04, between="hold")
    light = scene.frames(0, 8).mean(axis=(1, 2)) * 255
    assert np.abs(light - grey).max() < 25
    assert np.corrcoef(light, grey)[0, 1] > 0.99
    scene._kept.clear()
    np.testing.assert_allclose(scene.frames(2, 1).mean() * 255, light[2], atol=0.5)


def test_pad_fill_and_stretch(tmp_path):
    picture = np.zeros((4, 8), np.uint8)
    picture[:, 2:6] = 255
    Image.fromarray(picture).save(tmp_path / "p.png")
    means = [
        shown(tmp_path / "p.png", size=8, fit=fit).frames(0, 1).mean() for fit in ("fill", "pad", "stretch")
    ]
    assert means == pytest.approx([1.0, 0.25, 0.5], abs=1e-5)


def bad_files(tmp_path):
    nan = np.zeros((3, 4, 4), np.float32)
    nan[2, 1, 1] = np.nan
    for name, array in {
        "nan.npy": nan,
        "negative.npy": np.full((1, 4, 4), -1.0),
        "flat.npy": np.zeros(5),
        "empty.npy": np.zeros((0, 4, 4)),
        "complex.npy": np.zeros((2, 4, 4), complex),
        "rateless.npy": np.zeros((2, 4, 4)),
    }.items():
        np.save(tmp_path / name, array)
    (tmp_path / "noise.mp4").write_bytes(RNG.bytes(5000))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "flat.npy").read_bytes()[:40])
    (tmp_path / "objects.npy").write_bytes(b"\x93NUMPY\x01\x00")
    with (tmp_path / "archive.npy").open("wb") as archive:
        np.savez(archive, a=np.zeros(3))
    Image.fromarray(np.zeros((64, 64), np.uint8)).save(tmp_path / "cut.png")
    whole = (tmp_path / "cut.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nan.npy", r"is nan at frame 2, pixel \(1, 1\)"),
        ("negative.npy", "0 or more"),
        ("flat.npy", r"shape \(5,\)"),
        ("empty.npy", "shape"),
        ("complex.npy", "complex"),
        ("rateless.npy", "frame rate"),
        ("noise.mp4", "neither a picture nor a video"),
        ("cut.npy", "not an array"),
        ("objects.npy", "not an array"),
        ("archive.npy", "not an array"),
        ("cut.png", "cut.png"),
        ("missing.mp4", "does not exist"),
    ],
)
def test_invalid_files_are_refused_when_they_are_opened(tmp_path, name, words):
    bad_files(tmp_path)
    with pytest.raises(UsageError, match="(?s)" + words):
        shown(tmp_path / name)


WRONG = r"function wrong raised NameError in .*wave\.py, line 7: name 'brightness' is not defined"


def test_a_users_file_that_fails_is_named_with_its_line(tmp_path):
    """Its traceback, through our own code and its imports, was all that a user saw."""
    (tmp_path / "wave.py").write_text("RATE_HZ = 5e3\nPERIOD_S = 1 / (RATE_HZ - 5000)\n")
    (tmp_path / "scene.toml").write_text('kind = "function"\nfunction = "wave.py:wave"\n')
    with pytest.raises(UsageError, match=r"raised ZeroDivisionError in .*wave\.py, line 2: "):
        build_scene(load_scene(tmp_path / "scene.toml"), 5, 1e-4)


def test_a_users_function_in_a_file_next_to_the_scene(tmp_path):
    (tmp_path / "wave.py").write_text(
        "import numpy as np\n"
        "def wave(t, row, column):\n    return 0.5 + 0.5 * np.sin(6*row + 0*column + 1e3*t[:,None,None])\n"
        "def flat(t, row, column):\n    return np.ones((3, 3))\n"
        "def wrong(t, row, column):\n    return brightness * t\n"
        "def nan(t, row, column):\n    return np.full((len(t), row.size, column.size), np.nan)\n"
    )
    scene_file = tmp_path / "scene.toml"
    scene_file.write_text('kind = "function"\nfunction = "wave.py:wave"\n')
    frames = build_scene(load_scene(scene_file), 5, 1e-4).frames(2, 3)
    expected = 0.5 + 0.5 * np.sin(6 * 0.3 + 0.1 * np.arange(2.5, 5))
    np.testing.assert_allclose(frames[:, 1, 4], expected, rtol=1e-5)
    for name, words in (
        ("flat", r"shape \(3, 3\)"),
        ("nan", r"function nan is nan at sub-step 0, pixel \(0, 0\)"),
        ("none", "no function none"),
        ("wrong", WRONG),
    ):
        scene_file.write_text(f'kind = "function"\nfunction = "wave.py:{name}"\n')
        with pytest.raises(UsageError, match=words):
            build_scene(load_scene(scene_file), 5, 1e-4)


@pytest.mark.parametrize(
    "shutter",
    [
        {"kind": "window", "phases": [{"duration_s": 1.0, "axis": "row", "end": 1.0, "width": 0.2}]},
        {"kind": "chopper", "rotation_hz": 100.0},
    ],
)
def test_a_shutter_leaves_an_array_that_a_function_keeps_as_it_is(tmp_path, shutter):
    (tmp_path / "kept.py").write_text(
        "import numpy as np\n"
        "PICTURE = np.ones((12, 12), np.float32)\n"
        "VIDEO = np.ones((4, 12, 12), np.float32)\n"
        "def picture(t, row, column):\n    return np.broadcast_to(PICTURE, (len(t), 12, 12))\n"
        "def video(t, row, column):\n    return VIDEO[:len(t)]\n"
    )
    for name in ("picture", "video"):
        table = {"kind": "function", "function": f"{tmp_path}/kept.py:{name}", "shutters": [shutter]}
        scene = build_scene(SceneFile.model_validate(table).root, 12, 1e-3)
        before = scene.frames(0, 4)
        assert 0 < scene.frames(300, 4).mean() < 1
        np.testing.assert_array_equal(scene.frames(0, 4), before)


def test_a_users_picture_moves(tmp_path):
    Image.fromarray(np.full((20, 20, 2), 255, np.uint8), "LA").save(tmp_path / "fish.png")
    sprite = SpriteConfig(picture=str(tmp_path / "fish.png"), row=0.5, column=0.25, size=0.4)
    scene = build_scene(SpritesSceneConfig(kind="sprites", sprites=(sprite,)), 50, 1e-3)
    frame = scene.frames(0, 1)[0]
    assert frame.sum() == pytest.approx(400, rel=0.05)
    np.testing.assert_allclose(np.argwhere(frame > 0.5).mean(axis=0) + 0.5, (25, 12.5), atol=0.6)


def test_a_truncated_container_ends_with_its_last_frame(tmp_path):
    noise = RNG.integers(0, 255, (40, 64, 64)).astype(np.uint8)
    write_container(tmp_path / "late.mkv", noise, 25, "ffv1")
    whole = (tmp_path / "late.mkv").read_bytes()
    (tmp_path / "late.mkv").write_bytes(whole[: int(len(whole) * 0.7)])
    scene = shown(tmp_path / "late.mkv", size=8, substep_s=0.04, between="hold", end="last")
    assert 20 < scene._source.count < 35
    expected = resample(noise[10].astype(np.float32) / 255, 8)
    np.testing.assert_allclose(scene.frames(10, 1)[0], expected, atol=0.02)
    np.testing.assert_array_equal(*scene.frames(60, 2))


@pytest.mark.parametrize("name", ["a.gif", "a.webp", "a.png"])
def test_frames_of_different_durations_have_their_mean_rate(tmp_path, name):
    first, *rest = (Image.fromarray(np.full((8, 8), level, np.uint8)) for level in (0, 80, 160, 240))
    first.save(tmp_path / name, save_all=True, append_images=rest, duration=[100, 100, 100, 500], loop=0)
    scene = VideoScene(VideoSceneConfig(kind="video", path=tmp_path / name, between="hold"), 8, 0.01)
    changes = np.flatnonzero(np.diff(scene.frames(0, 80)[:, 0, 0])) + 1
    np.testing.assert_array_equal(changes, [20, 40, 60])


def test_a_frame_that_cannot_be_read_is_named(tmp_path, monkeypatch):
    frames = [Image.fromarray(np.full((9, 9), grey, np.uint8)) for grey in (1, 200, 90)]
    frames[0].save(tmp_path / "v.gif", save_all=True, append_images=frames[1:], duration=40)
    scene = shown(tmp_path / "v.gif", size=8, substep_s=0.04, between="hold")
    (tmp_path / "v.gif").write_bytes((tmp_path / "v.gif").read_bytes()[:40])
    with pytest.raises(DataError, match=r"v\.gif: frame 2 cannot be read"):
        scene.frames(2, 1)


def test_a_still_picture_s_optics_are_simulated_once(tmp_path):
    """Before a camera at full rate they were simulated at every sub-step, and the camera stalled."""
    np.save(tmp_path / "still.npy", np.random.default_rng(1).random((1, 48, 48)).astype(np.float32))
    config = VideoSceneConfig(kind="video", path=tmp_path / "still.npy")
    scene = config.build(24, 1e-5)
    assert isinstance(scene, StillScene)
    frames = VideoScene(config, 24, 1e-5).frames(-5, 40)
    np.testing.assert_array_equal(scene.frames(-5, 40), frames)
    np.save(tmp_path / "moving.npy", np.zeros((2, 8, 8), np.float32))
    moving = VideoSceneConfig(kind="video", path=tmp_path / "moving.npy", frame_rate_hz=10.0)
    assert isinstance(moving.build(8, 1e-5), VideoScene)
