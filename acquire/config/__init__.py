"""Models of the files in ``configs/``: rigs, scenes and reconstruction plans.

Unknown keys are refused. An error names the file, the key, its value and what is allowed. There is one module
per table of a rig file, and one for the contents of a scene file::

    files                                   paths, names and overrides -> validated models
    rig                                     a whole instrument
    device event fibre recording service web      its tables
    scene plan                              scenes of simulated cameras · plans of reconstructions
    effect                                  the base of all effects
    findings schema                         error messages · JSON schemas for editors
    variants                                tables whose model is a plug-in's class
    base                                    the base of all models
"""

from acquire.config.files import (
    check_directory,
    check_plan,
    find,
    find_again,
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
    "find_again",
    "load_plan",
    "load_recorded",
    "load_rig",
    "load_scene",
    "parse_settings",
]
