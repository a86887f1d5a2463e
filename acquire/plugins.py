"""Variants that any installed distribution may add: effects, scenes, drivers, solvers, denoisers.

Each is a class that an entry point names. Ours are listed in our own pyproject.toml as anybody's are in
theirs; PLUGINS.md says how to write one. A name is looked up without importing anything; a class is imported
when it is asked for by name. What cannot be imported is left out of every list and named with its error by
``acquire plugins``; only who asks for it by name is refused.

Our names cannot be taken: another distribution's class of the same name is left out, too. A name that two
other distributions have belongs to neither.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import tomllib
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from acquire.errors import ConfigError
from acquire.text import shortened, shown

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

OURS = "tdi-acquire"
_ENTRY_POINTS = "entry-points"


@dataclass(frozen=True, slots=True)
class Plugin:
    """An entry point of a group: who lists it under which name. Nothing of it is imported yet."""

    group: str
    name: str
    distribution: str
    version: str
    entry: metadata.EntryPoint
    refused: str = ""
    """Why the name is not its own; empty: it is."""

    @property
    def origin(self) -> str:
        return f"{self.distribution} {self.version}"


@dataclass(frozen=True, slots=True)
class Group:
    """One kind of variant.

    Attributes
    ----------
    name : of the entry points' group
    what : in errors and lists, a noun
    base : ``module:class`` that every class of the group extends
    """

    name: str
    what: str
    base: str

    def found(self) -> tuple[Plugin, ...]:
        """Every entry point of the group, ours first, refused ones too. Imports nothing."""
        return _found(self.name)

    def names(self) -> tuple[str, ...]:
        """What can be asked for, working or not, ours first. Imports nothing."""
        return tuple(plugin.name for plugin in self.found() if not plugin.refused)

    def load(self, name: str) -> Any:
        """The class of that name. Raises ConfigError where there is none, or where it cannot be used."""
        plugin = self._named(name)
        try:
            return _load(self, plugin.entry)
        except _BrokenError as error:
            raise ConfigError(
                f"{self.what} {name!r} of {plugin.origin} cannot be used: {error}",
                possible=self._listed(name),
                hint=f"another version of {plugin.distribution}; acquire plugins",
            ) from error

    def working(self) -> dict[str, Any]:
        """Name → class of all that can be imported, ours first; what cannot is left out."""
        return {plugin.name: _load(self, plugin.entry) for plugin in self.found() if not self.trouble(plugin)}

    def trouble(self, plugin: Plugin) -> str:
        """Why an entry point of this group gives nothing; empty where it does. Imports it."""
        if plugin.refused:
            return plugin.refused
        try:
            _load(self, plugin.entry)
        except _BrokenError as error:
            return str(error)
        return ""

    def _named(self, name: str) -> Plugin:
        for plugin in _found_ours(self.name):  # most often it is ours: nobody else's files are read
            if plugin.name == name:
                return plugin
        same = [plugin for plugin in self.found() if plugin.name == name]
        for plugin in same:
            if not plugin.refused:
                return plugin
        if same:
            raise ConfigError(
                f"{self.what} {name!r}: {same[0].refused}", possible=self._listed(), hint="uninstall one"
            )
        near = difflib.get_close_matches(str(name), self.names(), 1)
        guess = f": did you mean {near[0]!r}?" if near else ""
        raise ConfigError(
            f"{self.what} {shown(name)} is not known{guess}",
            possible=self._listed(),
            hint=_reinstall(self.name, name),
        )

    def _listed(self, without: str = "") -> str:
        """What can be asked for, and from where unless it is ours."""
        have = [plugin for plugin in self.found() if not plugin.refused and plugin.name != without]
        return ", ".join(
            each.name if each.distribution == OURS else f"{each.name} ({each.origin})" for each in have
        )


EFFECTS = Group("acquire.effects", "effect", "acquire.sim.effects.base:Effect")
SCENES = Group("acquire.scenes", "scene", "acquire.sim.scene:SceneModel")
SOLVERS = Group("acquire.solvers", "solver", "acquire.recon.solver:Solver")
DENOISERS = Group("acquire.denoisers", "denoiser", "acquire.recon.denoisers:Denoiser")
CAMERAS = Group("acquire.cameras", "camera driver", "acquire.camera.variant:CameraVariant")
TRIGGERS = Group("acquire.triggers", "trigger driver", "acquire.trigger.variant:TriggerVariant")

GROUPS = (EFFECTS, SCENES, CAMERAS, TRIGGERS, SOLVERS, DENOISERS)


def forget() -> None:
    """Look again at what is installed: for a process in which something was installed or mended."""
    for looked_up in (_found, _found_ours, _outcome):
        looked_up.cache_clear()


class _BrokenError(Exception):
    """What an entry point names cannot be imported, or is not what its group needs."""


@cache
def _found(group: str) -> tuple[Plugin, ...]:
    ours = _found_ours(group)
    theirs = [
        plugin
        for entry in metadata.entry_points(group=group)
        if (plugin := _plugin(group, entry)).distribution != OURS
    ]
    return (*ours, *_told_apart(sorted(theirs, key=lambda each: (each.name, each.distribution)), ours))


@cache
def _found_ours(group: str) -> tuple[Plugin, ...]:
    try:
        own = metadata.distribution(OURS)
    except metadata.PackageNotFoundError:
        return ()
    return tuple(
        Plugin(group, entry.name, OURS, own.version, entry) for entry in own.entry_points.select(group=group)
    )


def _plugin(group: str, entry: metadata.EntryPoint) -> Plugin:
    by = entry.dist
    name, version = ("an unknown distribution", "") if by is None else (by.name, by.version)
    return Plugin(group, entry.name, name, version, entry)


def _told_apart(theirs: Sequence[Plugin], ours: Sequence[Plugin]) -> Iterator[Plugin]:
    """``theirs``, refused where a name is ours or that of two."""
    taken = {plugin.name for plugin in ours}
    for plugin in theirs:
        origins = [other.origin for other in theirs if other.name == plugin.name]
        why = ""
        if plugin.name in taken:
            why = f"the name is {OURS}'s own"
        elif len(origins) > 1:
            why = f"{' and '.join(origins)} both have it"
        yield Plugin(
            group=plugin.group,
            name=plugin.name,
            distribution=plugin.distribution,
            version=plugin.version,
            entry=plugin.entry,
            refused=why,
        )


@cache
def _outcome(group: Group, entry: metadata.EntryPoint) -> tuple[Any, str]:
    """What an entry point names, or why it is of no use: tried once in a process."""
    try:
        loaded = entry.load()
    except (Exception, SystemExit) as error:  # noqa: BLE001  # another's module may fail in any way
        return None, shortened(f"{type(error).__name__}: {error}", 400)
    return loaded, _misfit(group, entry, loaded)


def _load(group: Group, entry: metadata.EntryPoint) -> Any:
    loaded, trouble = _outcome(group, entry)
    if trouble:
        raise _BrokenError(trouble)
    return loaded


def _misfit(group: Group, entry: metadata.EntryPoint, loaded: Any) -> str:
    """Why ``loaded`` is not what the group needs; empty where it is."""
    module, _, name = group.base.partition(":")
    base = getattr(importlib.import_module(module), name)
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        return f"{entry.value} is no class that extends {module}.{name}"
    if missing := sorted(getattr(loaded, "__abstractmethods__", ())):
        return f"{entry.value} does not define {', '.join(missing)}"
    kind = getattr(loaded, "model_fields", {}).get("kind")
    if kind is not None and get_args(kind.annotation) != (entry.name,):
        return f"{entry.value} needs kind: Literal[{entry.name!r}], as its entry point is named"
    return ""


def _reinstall(group: str, name: str) -> str:
    """What to do where a checkout lists what its installation does not yet know."""
    listed = _checkout().get(group, {})
    if name in listed or (listed and not _found_ours(group)):
        return f"pip install -e . --no-deps in {_root()}: its pyproject.toml is newer than what is installed"
    return "acquire plugins"


def _root() -> Path:
    return Path(__file__).parents[1]


def _checkout() -> dict[str, Any]:
    """The entry points in the pyproject.toml of the checkout that this is, group by group; else none."""
    try:
        project = tomllib.loads((_root() / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    except (OSError, ValueError, KeyError):
        return {}
    points: dict[str, Any] = project.get(_ENTRY_POINTS, {}) if project.get("name") == OURS else {}
    return points


def described(loaded: Any) -> str:
    """The first line of what a class says of itself."""
    return (inspect.getdoc(loaded) or "").partition("\n")[0]
