"""Reading the files in ``configs/`` and the user's own: found by path or name, overridden, validated."""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ValidationError

from acquire.config.findings import explained
from acquire.config.plan import ReconstructionPlan
from acquire.config.rig import RECORDED, RigConfig
from acquire.config.scene import SceneFile
from acquire.errors import ConfigError
from acquire.place import builtin_directory, builtin_names
from acquire.plugins import SCENES
from acquire.reading import read_regular
from acquire.text import did_you_mean, shortened, shown, unexpanded

if TYPE_CHECKING:
    from collections.abc import Sequence

    from acquire.config.scene import SceneBase

MOST_FILE_BYTES = 2**20
"""Largest configuration file; files written by hand have some kilobytes."""

_MODEL = "a file as `acquire config show rig-demo` prints it"
_EXAMPLES = {"scene": "scene-leds.toml", "plan": "plan-window.toml"}
"""Kind of file → a built-in one that is short; a whole rig file is printed by a command."""

M = TypeVar("M", bound=BaseModel)


_MARKS = {"rig": {"geometry", "cameras", "trigger"}, "scene": {"kind"}, "plan": {"segments"}}
"""Keys from which the kind of a file is recognised."""
_USES = {
    "rig": "acquire serve --config {0}, or acquire simulate SCENE --config {0}",
    "scene": "acquire simulate {0} --out NAME.zarr",
    "plan": "acquire reconstruct RECORDING --plan {0} --out VIDEO.zarr",
}
"""The commands that take a file of each kind."""


def find(name: str | Path, beside: Path | None = None, kind: str = "") -> Path:
    """Return the file ``name``: a path, a file next to ``beside``, or a built-in one (.toml may be omitted).

    ``kind``, one of rig, scene and plan, selects the built-in files that an error lists.
    """
    if not isinstance(name, str | Path):
        raise ConfigError(
            f"{shown(name)} cannot be a {kind or 'configuration'} file", possible="a path, or a built-in name"
        )
    # The user's own files come first, whatever names the built-in ones have.
    candidates = [Path(name)]
    if beside is not None:
        candidates.append(beside.parent / name)
    candidates += [builtin_directory() / name, builtin_directory() / f"{name}.toml"]
    for path in candidates:
        if os.path.isfile(path):  # noqa: PTH113  # Path.is_file raises for names that no file can have
            return path
    have = ", ".join(builtin_names(kind))
    what = f"{kind} file" if kind else "configuration file"
    near = did_you_mean(str(name), builtin_names(kind))
    raise ConfigError(
        f"{what} {shown(str(name))} {_why_no_file(name)}{near}",
        possible=f"a path, or one of the built-in {have}",
        hint=unexpanded(name),
    )


class Overrides(dict[str, Any]):
    """Overrides of `load_rig`, and the option of the command line that gives each, for errors."""

    def __init__(self) -> None:
        super().__init__()
        self.options: dict[str, str] = {}

    def give(self, key: str, value: object, option: str) -> None:
        """Add an override."""
        self[key], self.options[key] = value, option


def find_again(path: Path) -> None:
    """Raise ConfigError if the rig file that a service was started with is not there any more."""
    if not path.is_file():
        raise ConfigError(
            f"rig file {shown(str(path))}, with which the service was started, {_why_no_file(path)}: "
            "the service continues with what it has read",
            hint="put the file back, or restart the service with another --config while it is idle",
        )


def _why_no_file(name: str | Path) -> str:
    """Return what is wrong with the path of a file, as the end of a sentence."""
    if name and os.path.isdir(name):  # noqa: PTH112
        return "is a directory"
    if not _may_look_at(name):
        return "is in a directory that this user may not enter"
    # A link whose target is gone is a file to `lexists`, and none to `isfile`.
    if os.path.islink(name) and not os.path.exists(name):  # noqa: PTH110, PTH114
        return f"is a link to {shown(os.readlink(name))}, which leads to no file"  # noqa: PTH115
    return "is not a regular file" if os.path.lexists(name) else "does not exist"


def _may_look_at(name: str | Path) -> bool:
    try:
        os.lstat(name)
    except PermissionError:
        return False
    except (OSError, ValueError):  # it is not there, or no file can have this name
        return True
    return True


def load_rig(
    name: str | Path, overrides: Mapping[str, Any] | None = None, scene: str | None = None
) -> RigConfig:
    """Read, override (with dotted keys, as in ``{"simulation.speed": 10}``) and validate a rig file.

    Relative paths of scenes and calibrations are resolved against the file. ``scene`` is the scene of
    simulated cameras if the file names none.
    """
    path = find(name, kind="rig")
    table = _read(path)
    _check_kind(table, "rig", path)
    given: object = {} if overrides is None else overrides
    if not (isinstance(given, Mapping) and all(isinstance(key, str) for key in given)):
        raise ConfigError(
            f"{shown(given)} cannot override a rig file", possible="{'simulation.speed': 10}, dotted keys"
        )
    for dotted, value in given.items():
        *parents, last = dotted.split(".")
        inner = table
        for key in parents:
            # A setting may belong to a table that the file leaves out.
            inner = inner.setdefault(key, {})
            if not isinstance(inner, dict):
                raise ConfigError(
                    f"setting {shown(dotted)} cannot be set: {shown(key)} is a value and not a table",
                    possible=_SETTINGS,
                )
        inner[last] = value
    options = {key: getattr(given, "options", {}).get(key, "override") for key in given}
    rig = _validate(RigConfig, table, path, options=options)
    if (named := rig.calibration) is not None:
        # Relative to the working directory, as on a command line, or else to the file.
        calibration = named if os.path.lexists(named) else path.parent / named
        rig = rig.model_copy(update={"calibration": calibration.resolve()})
    if not rig.needs_scene:
        return rig
    # What the rig file names goes first: the scene given is for a rig that leaves it open.
    scene = scene if scene is not None and rig.simulation.scene is None else rig.scene_file()
    scene_path = find(scene, beside=path, kind="scene").resolve()
    simulation = rig.simulation.model_copy(update={"scene": str(scene_path)})
    return rig.model_copy(update={"simulation": simulation})


def check_directory(rig: RigConfig) -> None:
    """Raise ConfigError unless the directory for recordings exists."""
    directory = rig.recording.directory
    try:
        is_directory = stat.S_ISDIR(directory.stat().st_mode)
    except FileNotFoundError as error:
        raise ConfigError(
            f"recording.directory: there is no directory {directory}",
            hint=unexpanded(directory) or "create it first",
        ) from error
    except OSError as error:  # a loop of links, a name that is too long, a directory that may not be entered
        raise ConfigError(
            f"recording.directory: {shortened(directory)} cannot be used: {error.strerror}",
            hint="another directory",
        ) from error
    if not is_directory:
        raise ConfigError(
            f"recording.directory: {directory} is not a directory", hint="the path of a directory"
        )


_SETTINGS = "KEY=VALUE with a TOML value: code.seed=7, name='lab', cameras.a.serial='12'"
_QUOTABLE = re.compile(r"[^'\x00-\x1f]{1,200}")


def parse_settings(settings: Sequence[str]) -> Overrides:
    """Return settings such as ``["code.seed=7", "name='x'"]`` as overrides of `load_rig`; values are TOML."""
    overrides = Overrides()
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not (equals and all(part.strip() for part in key.split("."))):
            lacking = "key" if equals else "'='"
            raise ConfigError(f"setting {shown(setting)} has no {lacking}", possible=_SETTINGS)
        try:
            # RecursionError: tomllib has no limit of its own for brackets in brackets.
            overrides.give(key.strip(), tomllib.loads(f"value = {value}")["value"], "--set")
        except (ValueError, RecursionError) as error:
            # Only what can be pasted into a shell as it is.
            quoted = f"""put text in quotes: "{key}='{value}'" """.rstrip()
            raise ConfigError(
                f"setting {shown(setting)} has no valid TOML value: {shortened(error)}",
                possible=_SETTINGS,
                hint=quoted if _QUOTABLE.fullmatch(value) else "",
            ) from error
    return overrides


def load_scene(name: str | Path) -> SceneBase:
    """Read and validate a scene file; a picture or video file becomes a scene that shows it.

    Relative paths in it are resolved against the file.
    """
    path = find(name, kind="scene")
    if path.suffix != ".toml":
        scene: SceneBase = SCENES.load("video")(kind="video", title=path.name, path=path.resolve())
        return scene
    table = _read(path)
    _check_kind(table, "scene", path)
    return _validate(SceneFile, table, path).root.anchored(path.parent)


def load_recorded(attrs: Mapping[str, Any], origin: str | Path) -> tuple[RigConfig, SceneBase]:
    """Return the rig and the scene that a recording was simulated with; errors name ``origin``.

    The rig need not be able to capture here and now: older versions had other limits.
    Raises ConfigError if they need a plug-in that is not installed here.
    """
    where = f"{origin}, as it was recorded"
    rig = _validate(RigConfig, attrs["config"], where, RECORDED)
    return rig, _validate(SceneFile, attrs["scene"], where).root


def load_plan(name: str | Path) -> ReconstructionPlan:
    """Read and validate the plan of a combinatorial reconstruction."""
    path = find(name, kind="plan")
    table = _read(path)
    _check_kind(table, "plan", path)
    return check_plan(table, path)


def check_plan(table: dict[str, Any], origin: str | Path) -> ReconstructionPlan:
    """Return the plan that a table describes; errors name ``origin``."""
    return _validate(ReconstructionPlan, table, Path(origin))


def _read(path: Path) -> dict[str, Any]:
    try:
        # utf-8-sig: some editors begin a file with a byte order mark.
        text = read_regular(path, MOST_FILE_BYTES).decode("utf-8-sig")
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path} is not TOML: byte {error.start} is not UTF-8",
            possible="text in UTF-8",
            hint=f"an editor that saves as UTF-8; {_MODEL}",
        ) from error
    except RecursionError as error:
        raise ConfigError(f"{path} is not TOML: it is nested too deeply", hint=_MODEL) from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not TOML: {shortened(error, 400)}", hint=_MODEL) from error
    except ValueError as error:  # Python's own words name a setting of the interpreter
        raise ConfigError(
            f"{path} is not TOML: it holds a number of thousands of digits", hint=_MODEL
        ) from error
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror}", hint="its permissions, or another file"
        ) from error


def _check_kind(table: dict[str, Any], wanted: str, path: Path) -> None:
    """Raise ConfigError for an empty file, or one that clearly describes something other than ``wanted``."""
    if not table:
        example = _EXAMPLES.get(wanted)
        raise ConfigError(
            f"{path} has no keys: it is empty, or holds nothing but comments",
            possible=f"a {wanted} file",
            hint=_MODEL if example is None else f"a copy of {builtin_directory() / example}",
        )
    # In unclear cases the file is validated, and pydantic reports what is wrong with it.
    found = [kind for kind, keys in _MARKS.items() if keys & table.keys()]
    if len(found) == 1 and found != [wanted]:
        raise ConfigError(
            f"{path} describes a {found[0]}, but a {wanted} is needed here",
            possible=f"a {wanted} file",
            hint=_USES[found[0]].format(path.stem if path.parent == builtin_directory() else path),
        )


def _validate(
    model: type[M],
    table: dict[str, Any],
    path: Path | str,
    context: Mapping[str, Any] | None = None,
    options: Mapping[str, str] | None = None,
) -> M:
    try:
        return model.model_validate(table, context=context)
    except ValidationError as error:
        raise ConfigError(explained(error, model, path, options)) from error
