"""Scenes for the estimate of a video's error (`tools/bench_error.py`): it is fitted to those of `SCENES` and
tested on those in `KEPT`, to which nothing was fitted and by which nothing was chosen.

    leds goldfish digits usaf   the paper's, from configs/
    pan zoom turn               a photograph that moves, grows, turns
    curtain dissolve            one photograph slides over another, fades into it
    lamps                       two photographs that blink at 0.8 and 3.1 kHz, side by side
    rain bubbles                streaks that fall fast, discs that rise on a slope of light

    swing fan shadow pulse      tested: a rod that swings, blades that turn, a soft shadow that passes, a spot
                                of pulsing brightness, in front of a photograph
    ripples smoke               tested: waves of two sources; half transparent clouds in front of a photograph
    typing flashes              tested: squares that appear one by one, and lights that flare and fade

The photographs are those of scikit-image. Sizes are fractions of the picture, times fractions of the span.
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
from acquire.sim.canvas import Canvas
from acquire.sim.procedural import SUBSTEP_HZ, CameraNoise, Recorded, expose
from acquire.sim.scenes import build_scene
from acquire.sim.voxels import truth

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Frame = Callable[[int, float], NDArray[np.float32]]

OF_THE_PAPER = {name: f"scene-{name}" for name in ("leds", "goldfish", "digits", "usaf")}
PHOTOGRAPHS = ("astronaut", "brick", "camera", "cat", "coffee", "coins", "moon", "rocket")
FIRST_SUBSTEP = 600


def _photograph(s: Canvas, share: float = 1.0) -> NDArray[np.float32]:
    """A random grey crop of one of them, new at each call; its side in units of the picture's."""
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
    """n × n pixels about the middle of a photograph, transformed by a matrix and shifted by some pixels."""
    middle = (np.array(photo.shape) - 1) / 2 + shift
    offset = middle - matrix @ (np.full(2, n - 1) / 2)
    found = affine_transform(photo, matrix, offset, (n, n), order=1, mode="mirror")
    return np.asarray(found, np.float32)


def pan(s: Canvas) -> Frame:
    photo, angle, far = _photograph(s, 1.6), s.rng.uniform(0, 2 * np.pi), s.rng.uniform(0.1, 0.3)
    way = far * s.n * np.array([np.sin(angle), np.cos(angle)])
    return lambda _t, tau: _seen(photo, s.n, np.eye(2), (tau - 0.5) * way)


def zoom(s: Canvas) -> Frame:
    photo, most = _photograph(s, 1.5), s.rng.uniform(0.1, 0.35)
    return lambda _t, tau: _seen(photo, s.n, (1 - most * tau) * np.eye(2), np.zeros(2))


def turn(s: Canvas) -> Frame:
    photo, most = _photograph(s, 1.5), s.rng.uniform(0.2, 0.7)

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        c, d = np.cos(most * tau), np.sin(most * tau)
        return _seen(photo, s.n, np.array([[c, -d], [d, c]]), np.zeros(2))

    return frame


def curtain(s: Canvas) -> Frame:
    photos, slope = [_photograph(s), _photograph(s)], s.rng.uniform(-0.3, 0.3)

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        mask = s.inside(s.x + slope * (s.y - 0.5) - (0.2 + 0.6 * tau))
        return photos[0] * mask + photos[1] * (1 - mask)

    return frame


def dissolve(s: Canvas) -> Frame:
    photos = [_photograph(s), _photograph(s)]
    return lambda _t, tau: np.asarray((1 - tau) * photos[0] + tau * photos[1], np.float32)


def lamps(s: Canvas) -> Frame:
    photos, left = [_photograph(s), _photograph(s)], s.inside(s.x - 0.5)
    rest = np.float32(s.rng.uniform(0.1, 0.4))

    def frame(t: int, _tau: float) -> NDArray[np.float32]:
        a, b = (0.5 + 0.5 * np.sin(2 * np.pi * hz * t / SUBSTEP_HZ) for hz in (800.0, 3100.0))
        return np.asarray(photos[0] * left * (rest + a) + photos[1] * (1 - left) * (rest + b), np.float32)

    return frame


def rain(s: Canvas) -> Frame:
    ground, drops = 0.3 * _photograph(s), s.rng.uniform([0, 0, 0.7], [1, 1, 1.6], (14, 3))

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        image = ground
        for x, start, speed in drops:
            y = (start + speed * tau) % 1.2 - 0.1
            image = np.maximum(image, s.box(y, x, 0.12, 0.025))
        return np.asarray(image, np.float32)

    return frame


def bubbles(s: Canvas) -> Frame:
    found = s.rng.uniform([0.1, 0.4, 0.03, 0.2], [0.9, 1.3, 0.09, 0.7], (9, 4))
    phases = s.rng.uniform(0, 6, 9)

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        image = (0.6 - 0.4 * s.y).astype(np.float32)
        for (x, y, radius, speed), phase in zip(found, phases, strict=True):
            at = y - speed * tau, x + 0.04 * np.sin(9 * tau + phase)
            image = image * (1 - 0.7 * s.ball(*at, radius)) + 0.5 * s.ball(*at, 0.6 * radius)
        return image

    return frame


def swing(s: Canvas) -> Frame:
    photo, far, turns = _photograph(s), s.rng.uniform(0.3, 0.8), s.rng.uniform(0.5, 1.2)

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        rod = s.limb(0.05, 0.5, far * np.cos(2 * np.pi * turns * tau), 0.7, 0.07)
        return np.asarray(photo * (1 - rod) + 0.9 * rod, np.float32)

    return frame


def fan(s: Canvas) -> Frame:
    photo, turns = _photograph(s), s.rng.uniform(0.2, 0.5)
    angle, far = np.arctan2(s.y - 0.5, s.x - 0.5), np.hypot(s.y - 0.5, s.x - 0.5)

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        blade = s.inside(0.1 * (0.3 - np.cos(3 * (angle - 2 * np.pi * turns * tau)))) * s.inside(far - 0.4)
        return np.asarray(photo * (1 - 0.9 * blade), np.float32)

    return frame


def ripples(s: Canvas) -> Frame:
    (ys, xs), periods = s.rng.uniform(0.2, 0.8, (2, 2)), s.rng.uniform(1.5, 4, 2)
    far = [np.hypot(s.y - y, s.x - x) for y, x in zip(ys, xs, strict=True)]

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        both = sum(np.cos(2 * np.pi * (r / 0.15 - p * tau)) for r, p in zip(far, periods, strict=True))
        return np.asarray(0.5 + 0.22 * both, np.float32)

    return frame


def smoke(s: Canvas) -> Frame:
    layers, photo = [s.texture(0.03, 0.1, 0.2) for _ in range(2)], _photograph(s)
    ways = s.rng.uniform(-0.4, 0.4, (2, 2))

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        moved = [
            affine_transform(layer, np.eye(2), -tau * way * s.n, (s.n, s.n), order=1, mode="grid-wrap")
            for layer, way in zip(layers, ways, strict=True)
        ]
        thick = moved[0] * moved[1]
        return np.asarray(photo * (1 - thick) + 0.8 * thick, np.float32)

    return frame


def typing(s: Canvas) -> Frame:
    ground, keys = 0.25 * _photograph(s), s.rng.random((5, 6))
    cells = [(s.box(0.15 + 0.16 * r, 0.12 + 0.15 * c, 0.1, 0.09), keys[r, c]) for r, c in np.ndindex(5, 6)]

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        image = ground
        for cell, begins in cells:
            image = np.maximum(image, 0.8 * cell * (tau > begins))
        return np.asarray(image, np.float32)

    return frame


def pulse(s: Canvas) -> Frame:
    photo, (y, x), times = _photograph(s), s.rng.uniform(0.3, 0.7, 2), s.rng.uniform(3, 8)
    spot = np.exp(-(np.square(s.y - y) + np.square(s.x - x)) / 0.05)

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        return np.asarray(
            photo * (1 - 0.6 * spot * (0.5 - 0.5 * np.cos(2 * np.pi * times * tau))), np.float32
        )

    return frame


def shadow(s: Canvas) -> Frame:
    photo, angle = _photograph(s), s.rng.uniform(0, 2 * np.pi)
    along = (s.x - 0.5) * np.cos(angle) + (s.y - 0.5) * np.sin(angle)
    return lambda _t, tau: np.asarray(
        photo * (0.3 + 0.7 / (1 + np.exp((along + 0.6 - 1.2 * tau) / 0.06))), np.float32
    )


def flashes(s: Canvas) -> Frame:
    ground, found = 0.4 * _photograph(s), s.rng.uniform([0.1, 0.1, 0.1, 0.02], [0.9, 0.9, 0.9, 0.08], (8, 4))

    def frame(_t: int, tau: float) -> NDArray[np.float32]:
        image = ground
        for y, x, at, lasts in found:
            image = image + 0.6 * s.ball(y, x, 0.06) * float(np.exp(-(((tau - at) / lasts) ** 2)))
        return np.asarray(image, np.float32)

    return frame


OF_OUR_OWN = {each.__name__: each for each in (pan, zoom, turn, curtain, dissolve, lamps, rain, bubbles)}
SCENES = (*OF_THE_PAPER, *OF_OUR_OWN)
KEPT = {each.__name__: each for each in (swing, fan, ripples, smoke, typing, pulse, shadow, flashes)}


def record(name: str, seed: int, *, stages: int, substeps: int, lines: int, camera: CameraNoise) -> Recorded:
    """As `acquire.sim.procedural.record`."""
    geometry = Geometry(stages, substeps, lines)
    code = prbs(31, mix_seed(seed, 31), 0, geometry.span)
    if name in OF_THE_PAPER:
        scene = build_scene(load_scene(OF_THE_PAPER[name]), geometry.size, 1 / SUBSTEP_HZ)
        light = truth(scene, FIRST_SUBSTEP * seed, geometry.span, 1, 1)
    else:
        drawn = 1000 * seed + [*SCENES, *KEPT].index(name)  # otherwise all would show the same photograph
        frame = (OF_OUR_OWN | KEPT)[name](Canvas(geometry.size, geometry.span, drawn))
        light = np.stack([frame(t, t / (geometry.span - 1)) for t in range(geometry.span)])
    light = np.asarray(light, np.float32)
    exact = DualArm(geometry, code).forward(light).astype(np.float64)
    return Recorded(expose(exact, geometry, code, camera, seed), light)
