"""Effects with noticeable parameters, and their results on a small bench."""

from __future__ import annotations

from small_bench import DT, K, M, N, S, flat, read

from acquire.sim.effects.base import Setting
from acquire.sim.scenes import build_scene

FLAT = S * S * N
"""Y of a scene of light 1 that is always lit."""
PARAMETERS = {
    "code_errors": {"flip_rate": 0.02, "late_substeps": 1},
    "pwm": {"carrier_hz": 37e3, "bits": 6},
    "led_nonlinearity": {"saturation": 0.8},
    "led_rise_fall": {"rise_s": 3e-6, "fall_s": 5e-6},
    "delays": {"light_s": 7e-6, "a_s": 3e-6},
    "trigger_jitter": {"sigma_s": 1e-6},
    "misregistration": {"arm": "a", "rows": 0.4},
    "lens_distortion": {"part": 0.06},
    "vignetting": {"loss": 0.3},
    "psf": {"sigma_pixels": 1.2},
    "stray_light": {"veil": 0.05, "ambient": 0.02},
    "fibre_bands": {"shift_pixels": 0.5},
    "fibre_gain": {"columns": 0.05, "fibres": 0.1},
    "beam_splitter": {"part_a": 0.45},
    "cti": {"inefficiency": 1e-3},
    "prnu": {"prnu": 0.02},
    "shot_noise": {},
    "dark_current": {"electrons_per_s": 5e6},
    "dsnu": {"dsnu_e": 40.0},
    "column_defects": {"hot": 1, "hot_e": 300.0, "dead": 1},
    "full_well": {"capacity_e": 600.0},
    "read_noise": {"sigma_e": 60.0},
    "drift": {"hours": 2.0, "offset_dn_per_hour": 3.0, "gain_per_hour": 0.01},
    "column_offsets": {"sigma_dn": 4.0, "channels": 4},
    "adc_nonlinearity": {"bow": 0.03},
    "adc": {"bits": 8},
    "dropped_lines": {"rate": 0.02},
    "duplicated_lines": {"rate": 0.02},
}


def effects(*kinds, **changes):
    return [{"kind": kind, **PARAMETERS[kind], **changes} for kind in kinds]


def electrons(scene, **more):
    """DN back to electrons."""
    return (read(scene, **more).pixels.astype(float) - 300.0) / K


def setting(**changes):
    scene = build_scene(flat(), N, DT)
    facts = {
        "arm": "a",
        "seed": 0,
        "realisation": 0,
        "stages": M,
        "substeps": S,
        "pixels": M,
        "substep_s": DT,
    }
    camera = {"white_dn": 65535, "black_level_dn": 0.0, "responsivity_dn": 1.0, "gain_dn_per_e": K}
    return Setting(**(facts | camera | {"scene": scene} | changes))


def through(camera, value, *more):
    """Through every stage of a camera, in order."""
    for stage in camera.stages:
        value = stage.run(value, *more)
    return value
