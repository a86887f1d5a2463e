"""Scenes on which the estimate of a video's error was not calibrated (`tools/bench_error.py`).

    leds goldfish digits usaf   the paper's, from configs/
    pan zoom turn               a photograph that moves, grows, turns
    curtain dissolve            one photograph slides over another, fades into it
    lamps                       two photographs that blink at 0.8 and 3.1 kHz, side by side
    rain bubbles                streaks that fall fast, discs that rise on a slope of light

The photographs are scikit-image's. Sizes are shares of the picture and times shares of the span.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import affine_transform
from skimage import data
from skimage.transform import resize

from acquire.codes import mix_seed, prbs
from acquire.config import load_scene
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.sim.procedural import SUBSTEP_HZ, Camera, Recorded, Stage, expose
from acquire.sim.scenes import build_scene
from acquire.sim.voxels import truth

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Frame = Callable[[int, float], NDArray[np.float32]]

OF_THE_PAPER = {name: f"scene-{name}" for name in ("leds", "goldfish", "digits", "usaf")}
PHOTOGRAPHS = ("astronaut", "brick", "camera", "cat", "coffee", "coins", "moon", "rocket")
FIRST_SUBSTEP = 600


def _photograph(s: Stage, share: float = 1.0) -> NDArray[np.float32]:
    """A grey crop of one of them, drawn anew at each call, whose side is so many pictures."""
    whole = getattr(data, str(s.rng.choice(PHOTOGRAPHS)))().astype(np.float64)
    grey = whole.mean(2) if whole.ndim == 3 else whole
    side = min(grey.shape)
    row, column = (int(s.rng.integers(length - side + 1)) for length in grey.shape)
    crop = grey[row : row + side, column : column + side]
    n = round(share * s.n)
    return np.asarray(0.05 + 0.9 * resize(crop / crop.max(), (n, n), anti_aliasing=True), np.float32)


def _seen(
    photo: NDArray[np.float32], n: int, matrix: NDArray[np.float64], shift: NDArray[np.float64]
) -> NDArray[np.float32]:
    """n × n pixels of a photograph about its middle, through a matrix, beside it by a shift in pixels."""
    middle = (np.array(photo.shape) - 1) / 2 + shift
    offset = middle - matrix @ (np.full(2, n - 1) / 2)
    found = affine_transform(photo, matrix, offset, (n, n), order=1, mode="mirror")
    return np.asarray(found, np.float32)


def pan(s: Stage) -> Frame:
    photo, angle, far = _photograph(s, 1.6), s.rng.uniform(0, 2 * np.pi), s.rng.uniform(0.1, 0.3)
    way = far * s.n * np.array([np.sin(angle), np.cos(angle)])
    return lambda _t, tau: _seen(photo, s.n, np.eye(2), (tau - 0.5) * way)


def zoom(s: Stage) -> Frame:
    photo, most = _photograph(s, 1.5), s.rng.uniform(0.1, 0.35)
    return lambda _t, tau: _seen(photo, s.n, (1 - most * tau) * np.eye(2), np.zeros(2))


def turn(s: Stage) -> Frame:
    photo, most = _photograph(s, 1.5), s.rng.uniform(0.2, 0.7)

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        c, d = np.cos(most * tau), np.sin(most * tau)
        return _seen(photo, s.n, np.array([[c, -d], [d, c]]), np.zeros(2))

    return frame


def curtain(s: Stage) -> Frame:
    photos, slope = [_photograph(s), _photograph(s)], s.rng.uniform(-0.3, 0.3)

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        mask = s.inside(s.x + slope * (s.y - 0.5) - (0.2 + 0.6 * tau))
        return photos[0] * mask + photos[1] * (1 - mask)

    return frame


def dissolve(s: Stage) -> Frame:
    photos = [_photograph(s), _photograph(s)]
    return lambda _t, tau: np.asarray((1 - tau) * photos[0] + tau * photos[1], np.float32)


def lamps(s: Stage) -> Frame:
    photos, left = [_photograph(s), _photograph(s)], s.inside(s.x - 0.5)
    rest = np.float32(s.rng.uniform(0.1, 0.4))

    def frame(t: int, _tau: float) -> NDArray[np.float32]:
        a, b = (0.5 + 0.5 * np.sin(2 * np.pi * hz * t / SUBSTEP_HZ) for hz in (800.0, 3100.0))
        return np.asarray(photos[0] * left * (rest + a) + photos[1] * (1 - left) * (rest + b), np.float32)

    return frame


def rain(s: Stage) -> Frame:
    ground, drops = 0.3 * _photograph(s), s.rng.uniform([0, 0, 0.7], [1, 1, 1.6], (14, 3))

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        image = ground
        for x, start, speed in drops:
            y = (start + speed * tau) % 1.2 - 0.1
            image = np.maximum(image, s.box(y, x, 0.12, 0.025))
        return np.asarray(image, np.float32)

    return frame


def bubbles(s: Stage) -> Frame:
    found = s.rng.uniform([0.1, 0.4, 0.03, 0.2], [0.9, 1.3, 0.09, 0.7], (9, 4))
    phases = s.rng.uniform(0, 6, 9)

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        image = (0.6 - 0.4 * s.y).astype(np.float32)
        for (x, y, radius, speed), phase in zip(found, phases, strict=True):
            at = y - speed * tau, x + 0.04 * np.sin(9 * tau + phase)
            image = image * (1 - 0.7 * s.ball(*at, radius)) + 0.5 * s.ball(*at, 0.6 * radius)
        return image

    return frame


OF_OUR_OWN = {each.__name__: each for each in (pan, zoom, turn, curtain, dissolve, lamps, rain, bubbles)}
SCENES = (*OF_THE_PAPER, *OF_OUR_OWN)


def record(name: str, seed: int, *, stages: int, substeps: int, lines: int, camera: Camera) -> Recorded:
    """As `acquire.sim.procedural.record`."""
    geometry = Geometry(stages, substeps, lines)
    code = prbs(31, mix_seed(seed, 31), 0, geometry.span)
    if name in OF_THE_PAPER:
        scene = build_scene(load_scene(OF_THE_PAPER[name]), geometry.size, 1 / SUBSTEP_HZ)
        light = truth(scene, FIRST_SUBSTEP * seed, geometry.span, 1, 1)
    else:
        drawn = 1000 * seed + SCENES.index(name)  # or all would show the same photograph
        frame = OF_OUR_OWN[name](Stage(geometry.size, geometry.span, drawn))
        light = np.stack([frame(t, t / (geometry.span - 1)) for t in range(geometry.span)])
    light = np.asarray(light, np.float32)
    exact = DualArm(geometry, code).forward(light).astype(np.float64)
    return Recorded(expose(exact, geometry, code, camera, seed), light)
