"""What every effect is given, what it gives back, and where its random numbers come from."""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np

from acquire.config.effect import EffectConfig

if TYPE_CHECKING:
    from acquire.fibre import Fibre
    from acquire.sim.scene import Scene

Place = Literal["light", "image", "signal", "charge", "readout", "stream"]
PLACES: tuple[Place, ...] = get_args(Place)
"""Where in the chain a stage acts, in the order of the light's and the signal's way."""

TILE_LINES = 256
"""Random numbers of lines are drawn for tiles of so many, at fixed places."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What a stage may depend on besides its own parameters.

    Attributes
    ----------
    arm : "a", "b", or "ab" for the one sensor of the compact layout
    seed, realisation : of the random streams; temporal noise of another realisation is independent,
        fixed patterns stay
    stages, substeps, pixels : M and S of the sensor; pixels per line
    substep_s : duration of a sub-step
    scene : what it looks at
    white_dn, black_level_dn, responsivity_dn, gain_dn_per_e : of its camera
    settled_s : by which the trigger starts the charge's moves after the light's, on purpose
    lit_part : from where to where of a lit sub-step the trigger lets the light on
    fibre : what stands before the sensor and lays a larger scene out in bands; None: nothing does
    """

    arm: str
    seed: int
    realisation: int
    stages: int
    substeps: int
    pixels: int
    substep_s: float
    scene: Scene
    white_dn: int
    black_level_dn: float
    responsivity_dn: float
    gain_dn_per_e: float
    settled_s: float = 0.0
    lit_part: tuple[float, float] = (0.0, 1.0)
    fibre: Fibre | None = None

    @property
    def exposure_s(self) -> float:
        """t_exp of a line: M line periods."""
        return self.stages * self.substeps * self.substep_s


@dataclass(frozen=True, slots=True)
class Stage:
    """One step. ``run`` is a pure function; what it takes and gives depends on the place::

    light     Illumination → Illumination (wraps it)
    image     frames (k, n, n) → frames
    signal    lines (m, pixels), of which the first ``lead`` are only history, first line → lines
    charge    electrons (256, pixels) float64, first line → electrons
    readout   DN (256, pixels) float64, first line → DN
    stream    pixels (256, pixels), first line, the line before → pixels, missing (256,) or None
    """

    effect: str
    place: Place
    run: Callable[..., Any]
    lead: int = 0


class Effect(EffectConfig, ABC):
    """An effect: a model of its parameters, and the stages that these make. Named by an entry point.

    ``place`` is where it acts first, ``rank`` when within that place: lower ranks act first. Ours are 10, 20
    and so on; what says nothing acts after them.
    """

    place: ClassVar[Place]
    rank: ClassVar[float] = 1000

    @abstractmethod
    def stages(self, setting: Setting) -> list[Stage]:
        """What it does to one arm; empty where it does nothing there. Equal settings give equal stages."""


def draws(effect: str, setting: Setting, tile: int, *, arm: str | None = None) -> np.random.Generator:
    """The random stream of one effect, arm and tile; realisations of temporal noise differ."""
    key = (*_name_key(effect, arm or setting.arm), setting.realisation, 1, tile & 0xFFFFFFFF, tile < 0)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(setting.seed, spawn_key=key)))


def pattern(effect: str, setting: Setting) -> np.random.Generator:
    """The random stream of one effect's fixed pattern on one arm: the same for every line and realisation."""
    key = (*_name_key(effect, setting.arm), 0)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(setting.seed, spawn_key=key)))


def _name_key(effect: str, arm: str) -> tuple[int, int]:
    return zlib.crc32(effect.encode()), zlib.crc32(arm.encode())
