"""Procedural scenes, which no parameter was tuned on, as an ordinary camera records them.

    bullet    a small dark block crosses a bright textured still
    splash    a blob deforms and throws drops
    shock     a thin ring expands on dark ground
    disc      a checkered disc turns
    text      letters scroll
    spark     a flash of 12 sub-steps before a textured still
    flame     smooth texture flickers and rises
    flicker   everything's brightness changes while something moves
    runner    a jointed figure crosses textured ground
    traffic   boxes pass each other on a textured road
    leds      three lamps behind masks, sinusoids of 5, 2.5 and 1 kHz at 100 kHz, and one that is steady
    leds_dot  the same, and a dot that moves
    fastled   lamps of 20 kHz and 1 kHz
    still     a textured still
    fan       blades turn before a textured still
    string    a string vibrates, with an overtone
    piston    a crank moves a piston
    wheel     a textured wheel turns beside the middle before textured ground
    waves     waves on deep water, which run in all directions
    smoke     smooth texture is stirred by vortices and drifts
    ball      a bright ball is thrown, falls and bounces before a textured still
    pendulum  a bright bob swings on a dark rod before a textured still
    hopper    a bright ball hops across the whole field, fast

Sizes are fractions of the picture and times fractions of the span, so that a scene is the same at any M, S
and L_R; only the lamps have frequencies in sub-steps. The noise is that of a 12-bit camera whose brightest
sample is ``full_well_e`` electrons.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial import Legendre
from PIL import Image as Pil
from PIL import ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter, map_coordinates

from acquire.codes import mix_seed, prbs
from acquire.forward import DualArm, merge_video
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.noise import Noise
from acquire.sim.canvas import Canvas

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Image = NDArray[Any]

TOP_DN = 3700.0
"""The brightest sample: 90 % of 12 bits."""
SUBSTEP_HZ = 100e3


@dataclass(frozen=True)
class CameraNoise:
    """Noise of EMVA 1288's linear model; the brightest sample is ``full_well_e`` electrons."""

    full_well_e: float = 1e4
    read_noise_e: float = 10.0

    @property
    def noise(self) -> Noise:
        """Noise of the samples in DN, for both arms."""
        K = TOP_DN / self.full_well_e
        dark = 0.0 if np.isinf(self.full_well_e) else K * self.read_noise_e
        return Noise((K, K), (dark, dark))


CLEAN = CameraNoise(np.inf, 0.0)


@dataclass(frozen=True, eq=False)
class Recorded:
    """A segment, and the light (T, n, n) that it recorded."""

    segment: Segment
    light: NDArray[np.float32]

    def truth(self, spatial_merge: int, temporal_merge: int) -> NDArray[np.float32]:
        """Return the voxels that a reconstruction should find, for the trusted frames."""
        video = merge_video(self.light, spatial_merge, temporal_merge)
        return np.asarray(video[self.segment.geometry.trusted_frames(temporal_merge)], np.float32)


def _over(ground: Image, mask: Image, value: float | Image) -> Image:
    return np.asarray(ground * (1 - mask) + mask * value)


def bullet(s: Canvas) -> Callable[[int, float], Image]:
    """A dark block that crosses the textured ground at a constant speed."""
    row = s.rng.uniform(0.3, 0.7)
    return lambda _t, tau: _over(s.ground, s.box(row, -0.05 + 1.1 * tau, 0.052, 0.094), 0.05)


def splash(s: Canvas) -> Callable[[int, float], Image]:
    """A crown that rises and widens, and drops that fly off it."""
    angle, far = np.arctan2(s.y - 0.55, s.x - 0.5), np.hypot(s.y - 0.55, s.x - 0.5)
    phases, drops = (
        s.rng.uniform(0, 2 * np.pi, 4),
        s.rng.uniform([-0.5, 0.5, 0.015], [0.5, 1.1, 0.04], (7, 3)),
    )

    def frame(_t: int, tau: float) -> Image:
        rim = (
            0.14
            + 0.1 * tau
            + sum(
                0.035 * tau**0.5 * np.sin((k + 2) * angle + phases[k] + 4 * tau * (-1) ** k) for k in range(4)
            )
        )
        image = 0.04 + 0.8 * s.inside(far - rim)
        for sideways, up, radius in drops:
            y = 0.5 - up * 0.6 * tau + 0.5 * tau**2
            image = np.maximum(image, 0.9 * s.ball(y, 0.5 + sideways * tau, radius))
        return np.asarray(image, np.float32)

    return frame


def shock(s: Canvas) -> Callable[[int, float], Image]:
    """A thin bright ring that widens more and more slowly."""
    y, x = s.rng.uniform(0.4, 0.6, 2)
    far = np.hypot(s.y - y, s.x - x)
    return lambda _t, tau: 0.03 + 0.9 * s.inside(abs(far - 0.08 - 0.4 * tau**0.8) - 0.012)


def disc(s: Canvas) -> Callable[[int, float], Image]:
    """A disc with sectors in alternating rings, which makes 0.5 to 0.8 turns."""
    far, angle, start = np.hypot(s.y - 0.5, s.x - 0.5), np.arctan2(s.y - 0.5, s.x - 0.5), s.rng.uniform(0, 6)
    mask, rings = s.inside(far - 0.4), np.floor(far / 0.1)
    turns = s.rng.uniform(0.5, 0.8)

    def frame(_t: int, tau: float) -> Image:
        field = np.sin(6 * (angle + start - 2 * np.pi * turns * tau)) * (-1.0) ** rings
        return _over(np.float32(0.1) * np.ones_like(mask), mask, 0.35 + 0.25 * np.clip(field * 8, -1, 1))

    return frame


def text(s: Canvas) -> Callable[[int, float], Image]:
    """Three rows of letters that move to the left."""
    n, letters = s.n, "".join(s.rng.choice(list("ABCDEFGHKLMNPRSTXYZ0123456789"), 14))
    sheet = Pil.new("L", (3 * n, n))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=n // 4)
    for row in range(3):
        draw.text((n // 20, row * n // 3 + n // 40), letters[row * 4 :] + letters, fill=255, font=font)
    wide = np.asarray(sheet, np.float32) / 255
    speed = s.rng.uniform(0.35, 0.55)

    def frame(_t: int, tau: float) -> Image:
        whole, part = divmod(speed * n * tau, 1)
        # between whole pixels, so that letters move smoothly
        views = [wide[:, int(whole) + k : int(whole) + k + n] for k in (0, 1)]
        return np.float32(0.05) + np.float32(0.9) * ((1 - part) * views[0] + part * views[1]).astype(
            np.float32
        )

    return frame


def spark(s: Canvas) -> Callable[[int, float], Image]:
    """A flash of 12 sub-steps in front of a still ground."""
    begin, (y, x) = int(s.rng.uniform(0.42, 0.58) * s.span), s.rng.uniform(0.3, 0.7, 2)
    flash = np.exp(-((s.y - y) ** 2 + (s.x - x) ** 2) / 2 / 0.07**2).astype(np.float32)
    return lambda t, _tau: 0.5 * s.ground + (2.0 * flash if begin <= t < begin + 12 else np.float32(0))


def flame(s: Canvas) -> Callable[[int, float], Image]:
    """A flame: two layers of noise that rise at different speeds, in light that flickers as a whole."""
    fields = [
        gaussian_filter(s.rng.standard_normal((3 * s.n, s.n)), s.n * k, mode="wrap") for k in (0.05, 0.1)
    ]
    fields = [field / field.std() for field in fields]
    body = np.exp(-((s.x - 0.5) ** 2) / 2 / (0.05 + 0.2 * s.y) ** 2) * np.clip(1.3 * s.y, 0, 1)

    def frame(_t: int, tau: float) -> Image:
        rise = [int(speed * s.n * tau) for speed in (1.2, 0.8)]
        # the fields are three pictures high and wrap around: nothing repeats within a span
        waves = sum(np.roll(field, -step, axis=0)[: s.n] for field, step in zip(fields, rise, strict=True))
        breath = 1 + 0.15 * np.sin(2 * np.pi * 5 * tau)
        return np.asarray(0.02 + body * breath / (1 + np.exp(-1.2 * waves)), np.float32)

    return frame


def flicker(s: Canvas) -> Callable[[int, float], Image]:
    """A ball that crosses the ground, in light that flickers as a whole."""
    rate = s.rng.uniform(9, 15)

    def frame(_t: int, tau: float) -> Image:
        image = _over(s.ground, s.ball(0.5, 0.15 + 0.7 * tau, 0.12), 0.1)
        return image * np.float32(0.6 + 0.4 * np.sin(2 * np.pi * rate * tau))

    return frame


def runner(s: Canvas) -> Callable[[int, float], Image]:
    """A figure that crosses the ground with swinging arms and legs."""

    def frame(_t: int, tau: float) -> Image:
        x, swing, image = 0.1 + 0.8 * tau, 0.7 * np.sin(2 * np.pi * 3 * tau), s.ground * 0.6
        for angle in (swing, -swing):
            image = _over(image, s.limb(0.55, x, angle, 0.25, 0.05), 0.08)
            image = _over(image, s.limb(0.33, x, -1.2 * angle, 0.18, 0.04), 0.95)
        image = _over(image, s.limb(0.3, x, 0.0, 0.26, 0.1), 0.9)
        return _over(image, s.ball(0.21, x, 0.06), 0.75)

    return frame


def traffic(s: Canvas) -> Callable[[int, float], Image]:
    """Six lanes of cars, some of them in the other direction."""
    cars = s.rng.uniform([0.0, -1, 0.1], [1, 1, 1.0], (6, 3))

    def frame(_t: int, tau: float) -> Image:
        image = s.ground * 0.7
        for lane, (start, speed, grey) in enumerate(cars):
            x = (start + 0.6 * np.sign(speed) * (0.4 + abs(speed)) * tau) % 1.3 - 0.15
            image = _over(image, s.box((lane + 0.6) / 6.3, x, 0.09, 0.2), grey)
            image = _over(image, s.box((lane + 0.6) / 6.3, x, 0.05, 0.08), 1 - grey)
        return image

    return frame


def _lamps(s: Canvas, hertz: tuple[float, ...]) -> Callable[[int, float], Image]:
    shapes = [s.ball(0.27, 0.27, 0.16), s.box(0.27, 0.73, 0.24, 0.28), s.ball(0.73, 0.27, 0.17)]
    shapes[2] = shapes[2] * (1 - s.ball(0.73, 0.27, 0.08))
    steady = s.box(0.68, 0.73, 0.06, 0.3) + s.box(0.8, 0.73, 0.06, 0.3)
    phases = s.rng.uniform(0, 2 * np.pi, len(hertz))

    def frame(t: int, __tau: float) -> Image:
        image = 0.6 * steady if len(hertz) > 2 else np.zeros_like(steady)
        for shape, rate, phase in zip(shapes, hertz, phases, strict=False):
            image = image + shape * np.float32(0.5 + 0.5 * np.sin(2 * np.pi * rate * t / SUBSTEP_HZ + phase))
        return image

    return frame


def leds(s: Canvas) -> Callable[[int, float], Image]:
    """Three shapes that blink at 5, 2.5 and 1 kHz, and a steady one."""
    return _lamps(s, (5e3, 2.5e3, 1e3))


def leds_dot(s: Canvas) -> Callable[[int, float], Image]:
    """The lamps of `leds`, and a dot that crosses between them."""
    lamps = _lamps(s, (5e3, 2.5e3, 1e3))
    return lambda t, tau: _over(lamps(t, tau), s.ball(0.5, 0.1 + 0.8 * tau, 0.05), 0.8)


def fastled(s: Canvas) -> Callable[[int, float], Image]:
    """Two shapes that blink at 20 and 1 kHz."""
    return _lamps(s, (20e3, 1e3))


def still(s: Canvas) -> Callable[[int, float], Image]:
    """A picture that does not change, with details smaller than a voxel."""
    sharp = (s.texture(0.006, 0.02, 0.07) > 0.5).astype(np.float32)
    image = 0.15 + 0.7 * gaussian_filter(sharp, 0.5)
    return lambda _t, _tau: image


def fan(s: Canvas) -> Callable[[int, float], Image]:
    """A fan with three to five blades, of which 5 to 15 pass a point."""
    far, angle, start = np.hypot(s.y - 0.5, s.x - 0.5), np.arctan2(s.y - 0.5, s.x - 0.5), s.rng.uniform(0, 6)
    blades, rate = int(s.rng.integers(3, 6)), s.rng.uniform(5, 15)
    hub = s.inside(far - 0.38)

    def frame(_t: int, tau: float) -> Image:
        across = np.sin(blades * (angle + start) - 2 * np.pi * rate * tau) * far / blades  # of an edge
        return _over(0.8 * s.ground, s.inside(-across) * hub, 0.1)

    return frame


def string(s: Canvas) -> Callable[[int, float], Image]:
    """A string that swings in its first two modes."""
    rate, swing = s.rng.uniform(3, 12), s.rng.uniform(0.04, 0.1)

    def frame(_t: int, tau: float) -> Image:
        phase = 2 * np.pi * rate * tau
        y = (
            0.5
            + swing * np.sin(np.pi * s.x) * np.sin(phase)
            + 0.04 * np.sin(2 * np.pi * s.x) * np.sin(2 * phase)
        )
        return np.asarray(0.05 + 0.9 * s.inside(abs(s.y - y) - 0.03), np.float32)

    return frame


def piston(s: Canvas) -> Callable[[int, float], Image]:
    """A crank on a wheel, and the piston that it moves."""
    rate, (y, x), crank, rod = s.rng.uniform(2.5, 10), (0.6, 0.3), 0.13, 0.45

    def frame(_t: int, tau: float) -> Image:
        up, along = crank * np.sin(2 * np.pi * rate * tau), crank * np.cos(2 * np.pi * rate * tau)
        image = _over(np.full_like(s.x, 0.1), s.ball(y, x, 0.2), 0.5)
        image = _over(image, s.ball(y + up, x + along, 0.05), 0.95)
        return _over(image, s.box(y, x + along + np.sqrt(rod**2 - up**2), 0.16, 0.14), 0.8).astype(np.float32)

    return frame


def wheel(s: Canvas) -> Callable[[int, float], Image]:
    (y, x), radius = s.rng.uniform(0.4, 0.6, 2), s.rng.uniform(0.2, 0.35)
    turns, start = s.rng.choice([-1, 1]) * s.rng.uniform(0.2, 0.9), s.rng.uniform(0, 2 * np.pi)
    mask, face = s.ball(y, x, radius), (s.texture(0.02, 0.06) > 0.5).astype(np.float32)

    def frame(_t: int, tau: float) -> Image:
        angle = start + 2 * np.pi * turns * tau
        dy, dx = s.y - y, s.x - x
        rows = y + dy * np.cos(angle) - dx * np.sin(angle)
        columns = x + dx * np.cos(angle) + dy * np.sin(angle)
        at = [rows * s.n - 0.5, columns * s.n - 0.5]
        painted = map_coordinates(face, at, order=1, mode="nearest")
        return _over(0.6 * s.ground, mask, 0.1 + 0.9 * painted)

    return frame


def waves(s: Canvas) -> Callable[[int, float], Image]:
    """Waves on deep water, whose frequencies are in proportion to the root of their number across."""
    k, angle, phase = s.rng.uniform([2, 0, 0], [9, 2 * np.pi, 2 * np.pi], (40, 3)).T
    along = [n * (np.cos(each) * s.x + np.sin(each) * s.y) for n, each in zip(k, angle, strict=True)]
    amplitude = 0.8 / k

    def frame(_t: int, tau: float) -> Image:
        turns = [at - 1.6 * np.sqrt(n) * tau for n, at in zip(k, along, strict=True)]
        height = sum(
            a * np.cos(2 * np.pi * each + p) for a, each, p in zip(amplitude, turns, phase, strict=True)
        )
        return np.asarray(0.5 + 0.35 * np.tanh(height), np.float32)

    return frame


def smoke(s: Canvas) -> Callable[[int, float], Image]:
    """Smoke that three vortices stir while it drifts."""
    texture = gaussian_filter(s.rng.standard_normal((2 * s.n, 2 * s.n)), 0.04 * s.n, mode="wrap")
    vortices = s.rng.uniform([0.3, 0.3, -1.2 * np.pi], [0.7, 0.7, 1.2 * np.pi], (3, 3))

    def frame(_t: int, tau: float) -> Image:
        y, x = s.y, s.x
        for row, column, turn in vortices:
            dy, dx = y - row, x - column
            angle = turn * tau * np.exp(-(dy**2 + dx**2) / 2 / 0.15**2)
            y = row + np.cos(angle) * dy - np.sin(angle) * dx
            x = column + np.sin(angle) * dy + np.cos(angle) * dx
        density = map_coordinates(texture, [(y + 0.3 * tau) * s.n, x * s.n], order=1, mode="grid-wrap")
        return np.asarray(0.05 + 0.9 / (1 + np.exp(-1.5 * density / texture.std())), np.float32)

    return frame


def ball(s: Canvas) -> Callable[[int, float], Image]:
    """A thrown ball that falls and bounces two or three times."""
    begin, across, bounces = s.rng.uniform([0.15, 0.25, 1.8], [0.35, 0.5, 2.8])

    def frame(_t: int, tau: float) -> Image:
        u = bounces * tau % 1
        return _over(s.ground, s.ball(0.8 - 2 * u * (1 - u), begin + across * tau, 0.07), 0.95)

    return frame


def pendulum(s: Canvas) -> Callable[[int, float], Image]:
    """A bob that swings about once, on a rod."""
    swings, phase = s.rng.uniform([0.8, 0.0], [1.6, 2 * np.pi])

    def frame(_t: int, tau: float) -> Image:
        angle = 0.6 * np.sin(2 * np.pi * swings * tau + phase)
        rod = _over(0.7 * s.ground, s.limb(0.15, 0.5, angle, 0.55, 0.02), 0.05)
        return _over(rod, s.ball(0.15 + 0.55 * np.cos(angle), 0.5 + 0.55 * np.sin(angle), 0.08), 1.0)

    return frame


def hopper(s: Canvas) -> Callable[[int, float], Image]:
    """A ball that crosses dark ground in two or three hops."""
    radius, hops, height = s.rng.uniform([0.09, 2.0, 0.4], [0.13, 3.0, 0.6])

    def frame(_t: int, tau: float) -> Image:
        u = hops * tau % 1
        image = _over(
            np.full_like(s.x, 0.15), s.ball(0.82 - 4 * height * u * (1 - u), 0.2 + 0.6 * tau, radius), 0.9
        )
        return image.astype(np.float32)

    return frame


SCENES = {
    f.__name__: f
    for f in (
        bullet,
        splash,
        shock,
        disc,
        text,
        spark,
        flame,
        flicker,
        runner,
        traffic,
        leds,
        leds_dot,
        fastled,
        still,
        fan,
        string,
        piston,
        wheel,
        waves,
        smoke,
        ball,
        pendulum,
        hopper,
    )
}


def light(
    name: str, seed: int, n: int, span: int, speed_changes: Sequence[float] = ()
) -> NDArray[np.float32]:
    """Return the scene as a video (span, n, n).

    Everything but lamps moves at 1 + Σ sᵢ·Pᵢ(x) of its usual speed, with ``speed_changes`` s₁, s₂, … and
    Legendre's polynomials Pᵢ over the span, x = −1 … 1.
    """
    frame = SCENES[name](Canvas(n, span, seed))
    moved = Legendre([1.0, *speed_changes]).integ(lbnd=-1) / 2
    video = np.empty((span, n, n), np.float32)
    for t, tau in enumerate(moved(np.linspace(-1, 1, span))):
        video[t] = frame(t, float(tau))
    return video


def record(
    name: str,
    seed: int,
    *,
    stages: int = 64,
    substeps: int = 3,
    lines: int = 263,
    camera: CameraNoise = CameraNoise(),
    speed_changes: Sequence[float] = (),
) -> Recorded:
    """Return the scene as recorded; ``seed`` determines scene, code and noise (`light` has the rest)."""
    geometry = Geometry(stages, substeps, lines)
    code = prbs(31, mix_seed(seed, 31), 0, geometry.span)
    video = light(name, seed, geometry.size, geometry.span, speed_changes)
    exact = DualArm(geometry, code).forward(video).astype(np.float64)
    return Recorded(expose(exact, geometry, code, camera, seed), video)


def expose(
    exact: NDArray[np.float64], geometry: Geometry, code: NDArray[np.uint8], camera: CameraNoise, seed: int
) -> Segment:
    """Return Y of Eq. (1) as the 12-bit lines of a camera."""
    # Not `seed` alone, from which the scene was drawn: noise must not repeat those draws.
    rng, top = np.random.default_rng([seed, 1]), exact.max()
    if np.isfinite(camera.full_well_e):
        electrons = rng.poisson(
            exact * (camera.full_well_e / top)
        ) + camera.read_noise_e * rng.standard_normal(exact.shape)
        lines = np.rint(electrons * (TOP_DN / camera.full_well_e) + BLACK_DN)
    else:
        lines = np.rint(exact * (TOP_DN / top) + BLACK_DN)
    pixels = np.clip(lines, 0, 4095).astype(np.uint16)
    time_ns = (np.arange(geometry.lines) * round(1e9 * geometry.substeps / SUBSTEP_HZ)).astype(np.int64)
    return Segment(
        lines=pixels,
        mask=(pixels < 4095),  # saturated samples, as a recording masks them
        code=code,
        geometry=geometry,
        time_ns=time_ns,
        substep_ns=1e9 / SUBSTEP_HZ,
        black_level_dn=BLACK_DN,
        responsivity_dn=TOP_DN / top,
        noise=camera.noise,
    )


BLACK_DN = 100.0
"""Black level, high enough that noise around darkness is not clipped."""
