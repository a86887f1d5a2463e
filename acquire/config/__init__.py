"""Models of the files in ``configs/``: what a rig is, what a scene shows, what a plan asks for.

Unknown keys are refused. An error names the file, the key, what stood there and what is allowed. A file per
table of a rig file, a file for all that a scene file may hold::

    files                                   paths, names and overrides -> validated models
    rig                                     a whole instrument
    device event recording service web      its tables
    scene plan                              what simulated cameras see · what a reconstruction combines
    effect                                  what all effects have in common
    findings schema                         what is to be mended, in words · JSON schemas for editors
    variants                                tables of an installed class
    base                                    what all models refuse
"""

from acquire.config.files import (
    check_directory,
    check_plan,
    find,
    load_plan,
    load_recorded,
    load_rig,
    load_scene,
    parse_settings,
)
from acquire.config.rig import ConstantCodeConfig, GeometryConfig, PrbsConfig, RigConfig
from acquire.place import builtin_directory

__all__ = [
    "ConstantCodeConfig",
    "GeometryConfig",
    "PrbsConfig",
    "RigConfig",
    "builtin_directory",
    "check_directory",
    "check_plan",
    "find",
    "load_plan",
    "load_recorded",
    "load_rig",
    "load_scene",
    "parse_settings",
]
