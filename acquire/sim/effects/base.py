"""The interface of effects: their setting, their stages and their random streams."""

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
"""Places in the chain where a stage can act, in the order in which light and signal pass them."""

TILE_LINES = 256
"""Random numbers are drawn for tiles of this many lines, at fixed positions."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Everything that a stage may depend on, apart from its own parameters.

    Attributes
    ----------
    arm : "a", "b", or "ab" for the one sensor of the compact layout
    seed, realisation : select the random streams; temporal noise is independent between realisations,
        fixed patterns are the same
    stages, substeps, pixels : M and S of the sensor; pixels per line
    substep_s : duration of a sub-step
    scene : the scene before the sensor
    white_dn, black_level_dn, responsivity_dn, gain_dn_per_e : properties of the camera
    settled_s : time by which the trigger deliberately starts the charge transfers after the light
    lit_part : begin and end of the light within a lit sub-step, as fractions of it
    fibre : the fibre that lays a larger scene out on the sensor in bands; None: no fibre
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
        """Exposure time t_exp of a line: M line periods."""
        return self.stages * self.substeps * self.substep_s


@dataclass(frozen=True, slots=True)
class Stage:
    """One step. ``run`` is a pure function whose arguments and result depend on the place::

    light     Illumination → Illumination (wraps it)
    image     frames (k, n, n) → frames
    signal    lines (m, pixels), of which the first ``lead`` are history only, first line → lines
    charge    electrons (256, pixels) float64, first line → electrons
    readout   DN (256, pixels) float64, first line → DN
    stream    pixels (256, pixels), first line, the line before → pixels, missing (256,) or None
    """

    effect: str
    place: Place
    run: Callable[..., Any]
    lead: int = 0


class Effect(EffectConfig, ABC):
    """An effect: the model of its parameters, which builds its stages. Named by an entry point.

    ``place`` is where it acts first; ``rank`` orders the effects of one place, lowest first. The built-in
    effects have ranks 10, 20 and so on; an effect without a rank acts after them.
    """

    place: ClassVar[Place]
    rank: ClassVar[float] = 1000

    @classmethod
    def flaw(cls) -> str:
        """Return what the class lacks, as the rest of a sentence; empty if nothing."""
        return "" if getattr(cls, "place", None) in PLACES else f"needs place: one of {', '.join(PLACES)}"

    @abstractmethod
    def stages(self, setting: Setting) -> list[Stage]:
        """Return its stages for one arm, none if it does not act there. Equal settings give equal stages."""


def draws(effect: str, setting: Setting, tile: int, *, arm: str | None = None) -> np.random.Generator:
    """Return the random stream of one effect, arm and tile; it differs between realisations."""
    # Keys must not be negative, and tiles of the preroll are: the sign is a word of its own.
    key = (*_name_key(effect, arm or setting.arm), setting.realisation, 1, tile & 0xFFFFFFFF, tile < 0)
    # Not `default_rng`, whose generator a later NumPy may replace: the same seed would give other lines.
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(setting.seed, spawn_key=key)))


def pattern(effect: str, setting: Setting) -> np.random.Generator:
    """Return the random stream of an effect's fixed pattern on one arm, the same in every realisation."""
    key = (*_name_key(effect, setting.arm), 0)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(setting.seed, spawn_key=key)))


def _name_key(effect: str, arm: str) -> tuple[int, int]:
    # Not `hash`, which differs between processes: lines must be the same in each.
    return zlib.crc32(effect.encode()), zlib.crc32(arm.encode())
