"""Variants that any installed distribution may add: effects, scenes, drivers, codecs, solvers, denoisers.

Each is a class that an entry point names. Ours are listed in our own pyproject.toml, just as others list
theirs; PLUGINS.md describes how to write one. A name is looked up without importing anything, and a class is
imported when it is requested by name. A class that cannot be imported is left out of every list, and
``acquire plugins`` shows its error. Only a request for it by name is refused.

Our names cannot be taken: another distribution's class of the same name is left out, too. A name that two
other distributions claim belongs to neither.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import inspect
import sys
import tomllib
import traceback
from dataclasses import dataclass, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from acquire.errors import ConfigError
from acquire.text import shortened, shown

if TYPE_CHECKING:
    from collections.abc import Iterable

OURS = "tdi-acquire"
_ENTRY_POINTS = "entry-points"


@dataclass(frozen=True, slots=True)
class Plugin:
    """An entry point of a group, its name and its distribution. Nothing of it is imported yet."""

    group: str
    name: str
    distribution: str
    version: str
    entry: metadata.EntryPoint
    refused: str = ""
    """Why the plug-in cannot have the name; empty if it can."""

    @property
    def origin(self) -> str:
        return f"{self.distribution} {self.version}"


@dataclass(frozen=True, slots=True)
class Group:
    """One kind of variant.

    Attributes
    ----------
    name : name of the entry points' group
    what : noun for errors and lists
    base : ``module:class`` that every class of the group extends
    built_in : names that are known without their classes, and even without an installation
    """

    name: str
    what: str
    base: str
    built_in: tuple[str, ...] = ()

    def found(self) -> tuple[Plugin, ...]:
        """Return every entry point of the group, ours first, including refused ones. Imports nothing."""
        return _found(self.name)

    def names(self) -> tuple[str, ...]:
        """Return the names that can be requested, working or not, ours first. Imports nothing."""
        return tuple(plugin.name for plugin in self.found() if not plugin.refused)

    def load(self, name: str) -> Any:
        """Return the class of that name. Raises ConfigError if there is none, or if it cannot be used."""
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
        """Return name → class of all that can be imported, ours first."""
        return {plugin.name: _load(self, plugin.entry) for plugin in self.found() if not self.trouble(plugin)}

    def whose(self, name: str) -> str:
        """Return kind, name and distribution of somebody else's class, for errors; empty if it is ours."""
        if any(plugin.name == name for plugin in _found_ours(self.name)):
            return ""  # most are, and the metadata of other distributions need not be read
        found = (plugin.origin for plugin in self.found() if plugin.name == name and not plugin.refused)
        return "".join(f"{self.what} {name!r} of {origin}" for origin in found)

    def trouble(self, plugin: Plugin) -> str:
        """Return why an entry point of this group is unusable, or an empty text. Imports it."""
        if plugin.refused:
            return plugin.refused
        try:
            _load(self, plugin.entry)
        except _BrokenError as error:
            return str(error)
        return ""

    def _named(self, name: str) -> Plugin:
        # Most names are ours, which are found without reading the metadata of other distributions.
        for plugin in _found_ours(self.name):
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
            hint=_hint_for_unknown(self.name, name),
        )

    def _listed(self, without: str = "") -> str:
        """List the names that can be requested, with their origin unless they are ours."""
        named = [plugin for plugin in self.found() if not plugin.refused and plugin.name != without]
        # Ours are not imported for a list: what they lack is an extra, which the error then names.
        usable = [each for each in named if each.distribution == OURS or not self.trouble(each)]
        texts = [
            each.name if each.distribution == OURS else f"{each.name} ({each.origin})" for each in usable
        ]
        return ", ".join(dict.fromkeys([*self.built_in, *texts]))


EFFECTS = Group("acquire.effects", "effect", "acquire.sim.effects.base:Effect")
SCENES = Group("acquire.scenes", "scene", "acquire.sim.scene:SceneModel")
SOLVERS = Group("acquire.solvers", "solver", "acquire.recon.solver:Solver")
DENOISERS = Group("acquire.denoisers", "denoiser", "acquire.recon.denoisers:Denoiser")
CAMERAS = Group("acquire.cameras", "camera driver", "acquire.camera.variant:CameraVariant")
TRIGGERS = Group("acquire.triggers", "trigger driver", "acquire.trigger.variant:TriggerVariant")
# Every recording needs one of ours: at least for its times and flags.
CODECS = Group(
    "acquire.codecs", "codec", "acquire.store.variant:CodecVariant", ("auto", "none", "lz4", "zstd")
)

GROUPS = (EFFECTS, SCENES, CAMERAS, TRIGGERS, CODECS, SOLVERS, DENOISERS)


def forget() -> None:
    """Forget what is installed, so that it is looked up again: after an installation by this process."""
    for cached in (_found, _found_ours, _outcome):
        cached.cache_clear()


class _BrokenError(Exception):
    """The object that an entry point names cannot be imported, or is not what its group needs."""


@cache
def _found(group: str) -> tuple[Plugin, ...]:
    """Return ours, then theirs, which are refused if the name is ours or if two distributions claim it."""
    ours = _found_ours(group)
    theirs = []
    for entry in metadata.entry_points(group=group):
        dist = entry.dist
        name, version = ("an unknown distribution", "") if dist is None else (dist.name, dist.version)
        if name != OURS:
            theirs.append(Plugin(group, entry.name, name, version, entry))
    # In an order that does not depend on that of the search path.
    theirs.sort(key=lambda each: (each.name, each.distribution))
    taken = {plugin.name for plugin in ours} | {
        name for each in GROUPS if each.name == group for name in each.built_in
    }
    for number, plugin in enumerate(theirs):
        origins = [other.origin for other in theirs if other.name == plugin.name]
        if plugin.name in taken:
            theirs[number] = replace(plugin, refused=f"the name is {OURS}'s own")
        elif len(origins) > 1:
            theirs[number] = replace(plugin, refused=f"{' and '.join(origins)} both have it")
    return (*ours, *theirs)


@cache
def _found_ours(group: str) -> tuple[Plugin, ...]:
    try:
        own = metadata.distribution(OURS)
    except metadata.PackageNotFoundError:
        return ()
    return tuple(
        Plugin(group, entry.name, OURS, own.version, entry) for entry in own.entry_points.select(group=group)
    )


@cache
def _outcome(group: Group, entry: metadata.EntryPoint) -> tuple[Any, str]:
    """Return the object that an entry point names, and why it is unusable; tried once per process."""
    if entry.pattern.match(entry.value) is None:  # the standard library's own error says nothing
        return None, f"its entry point {shown(entry.value)} is not MODULE:CLASS"
    try:
        # What a module prints as it is imported would be in the midst of a command's JSON.
        with contextlib.redirect_stdout(sys.stderr):
            loaded = entry.load()
    except (Exception, SystemExit) as error:  # noqa: BLE001  # somebody else's module may fail in any way
        return None, shortened(f"{type(error).__name__}: {error}".removesuffix(": "), 400)
    return loaded, _unsuitable(group, entry, loaded)


def _load(group: Group, entry: metadata.EntryPoint) -> Any:
    loaded, trouble = _outcome(group, entry)
    if trouble:
        raise _BrokenError(trouble)
    return loaded


def _unsuitable(group: Group, entry: metadata.EntryPoint, loaded: Any) -> str:
    """Return why ``loaded`` is not what the group needs, or an empty text."""
    module, _, name = group.base.partition(":")
    base = getattr(importlib.import_module(module), name)
    if group is DENOISERS:
        return _unsuitable_denoiser(entry, loaded) or _miscalled(base, entry, loaded)
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        return f"{entry.value} is not a class that extends {module}.{name}"
    if missing := sorted(getattr(loaded, "__abstractmethods__", ())):
        return f"{entry.value} does not define {', '.join(missing)}"
    kind = getattr(loaded, "model_fields", {}).get("kind")
    if kind is not None and get_args(kind.annotation) != (entry.name,):
        return f"{entry.value} needs kind: Literal[{entry.name!r}], the name of its entry point"
    flaw: str = getattr(loaded, "flaw", str)()
    return f"{entry.value} {flaw}" if flaw else _miscalled(base, entry, loaded)


def _miscalled(base: type, entry: metadata.EntryPoint, loaded: type) -> str:
    """Return which method does not take the arguments of the base's, or an empty text.

    When it is called, the error arises in our module, and does not show whose the method is.
    """
    methods = [part for each in base.__mro__ if each.__module__.startswith("acquire.") for part in vars(each)]
    for name in methods:
        theirs, ours = (inspect.getattr_static(each, name, None) for each in (loaded, base))
        if (
            name.startswith("_")
            or theirs is ours
            or not (inspect.isfunction(theirs) and inspect.isfunction(ours))
        ):
            continue
        needed = list(inspect.signature(ours).parameters)
        try:
            inspect.signature(theirs).bind(*needed)
        except TypeError as error:
            return f"{entry.value} needs {name}({', '.join(needed)}): {error}"
    return ""


def _unsuitable_denoiser(entry: metadata.EntryPoint, loaded: Any) -> str:
    if not (isinstance(loaded, type) and callable(getattr(loaded, "prox", None))):
        return f"{entry.value} is not a class with a method prox(frames, weight)"
    try:
        inspect.signature(loaded).bind()
    except TypeError as error:
        return f"{entry.value} cannot be made without arguments: {error}"
    return ""


def _hint_for_unknown(group: str, name: str) -> str:
    """Return what to try: an installation if this is a checkout that lists the name, else the list."""
    root = Path(__file__).parents[1]
    try:
        project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    except (OSError, ValueError, KeyError):
        project = {}  # not a checkout
    listed = project.get(_ENTRY_POINTS, {}).get(group, {}) if project.get("name") == OURS else {}
    if name in listed or (listed and not _found_ours(group)):
        return f"pip install -e . --no-deps in {root}: its pyproject.toml is newer than the installation"
    return "acquire plugins"


def raised_by(error: BaseException) -> str:
    """Return the module and distribution of somebody else's plug-in in which an error arose; else empty."""
    files = {frame.filename for frame in traceback.extract_tb(error.__traceback__)}
    for group in GROUPS:
        for plugin in group.found():
            module = sys.modules.get(plugin.entry.module) if plugin.distribution != OURS else None
            if getattr(module, "__file__", None) in files:
                return f"{plugin.entry.module} of {plugin.origin}"
    return ""


def of_others(named: Iterable[tuple[Group, str]]) -> list[dict[str, str]]:
    """Return which of these variants come from other distributions, as recordings and videos state it (JSON).

    Each once, in the order given. A name that is not, or no longer, installed is left out.
    """
    found = {}
    for group, name in named:
        for plugin in group.found():
            if plugin.name == name and plugin.distribution != OURS and not plugin.refused:
                found[group, name] = {
                    "kind": group.what,
                    "name": name,
                    "distribution": plugin.distribution,
                    "version": plugin.version,
                }
    return list(found.values())


def unknown_groups() -> dict[str, list[str]]:
    """Return groups of entry points named like ours that do not exist → the distributions that have them."""
    known = {group.name for group in GROUPS}
    found: dict[str, list[str]] = {}
    for distribution in metadata.distributions():
        for group in {entry.group for entry in distribution.entry_points} - known:
            if group.startswith("acquire."):
                found.setdefault(group, []).append(distribution.name)
    return found


def described(loaded: Any) -> str:
    """Return the first line of a class's docstring."""
    return (inspect.getdoc(loaded) or "").partition("\n")[0]
